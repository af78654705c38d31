"""Pages in a real browser where there is one."""

import shutil

import cv2
import numpy as np
import pytest
from pydrake.geometry import Meshcat


class Page:
    """A page in a browser, with the errors that it reports.

    Args:
        tab: Playwright's.
        path: the page.
        settled: JavaScript that is true when the picture is complete.
        hidden: CSS selectors of elements that are not part of the picture.
    """

    def __init__(self, tab, path, settled: str, hidden: str):
        self.tab, self.settled, self.hidden, self.errors = tab, settled, hidden, []
        tab.on("console", lambda message: self._note(message.type, message.text))
        tab.on("pageerror", lambda error: self._note("error", str(error)))
        tab.goto(path.as_uri())
        self.settle()

    def _note(self, kind: str, text: str) -> None:
        if kind in ("error", "warning") and not any(
            word in text for word in ("GPU stall", "swiftshader", "getImageData")
        ):
            self.errors.append(text)

    def settle(self) -> None:
        """Waits until the picture is complete."""
        self.tab.wait_for_function(f"{self.settled} && !viewer.needs_render")

    def run(self, script: str):
        """The value of an expression in the page, once it has been drawn."""
        value = self.tab.evaluate(script)
        self.settle()
        return value

    def set_slider(self, id: str, value: float) -> None:
        self.tab.evaluate(
            f"() => {{ const s = document.getElementById('{id}'); s.value = {value};"
            " s.dispatchEvent(new Event('input')); }"
        )
        self.settle()

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8, blue first, of the scene alone."""
        self.tab.add_style_tag(content=f"{self.hidden}, .dg {{ display: none !important }}")
        self.settle()
        return cv2.imdecode(np.frombuffer(self.tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture(scope="session")
def browser():
    """Chromium; skips the test if it is not on the PATH."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("there is no Chromium on the PATH")
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=chromium, args=flags)


@pytest.fixture
def open_in_browser(browser, tmp_path):
    """Opens HTML as a `Page` in a window of this width and height [px]; no page may have errors."""
    pages = []

    def opened(html: str, width: int, height: int, settled: str, hidden: str) -> Page:
        path = tmp_path / "page.html"
        path.write_text(html)
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.set_default_timeout(120_000)
        pages.append(Page(tab, path, settled, hidden))
        return pages[-1]

    yield opened
    for page in pages:
        page.tab.close()
        assert page.errors == []


@pytest.fixture
def plain_meshcat():
    """Makes a Meshcat of one background color, without grid and axes."""

    def make(background=(0.0, 0.0, 0.0)) -> Meshcat:
        meshcat = Meshcat()
        for path in ("/Grid", "/Axes"):
            meshcat.SetProperty(path, "visible", False)
        for end in ("top_color", "bottom_color"):
            meshcat.SetProperty("/Background/<object>", end, list(background))
        return meshcat

    return make
