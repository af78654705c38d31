"""A picture of a page: two views side by side.

    splatpilot fly --seed 7 --out out/fly
    python docs/picture_of_page.py out/fly/flight.html docs/page.jpg
    splatpilot view scenes/bookstore --out out/bookstore.html
    python docs/picture_of_page.py out/bookstore.html docs/place.jpg

It needs a Chromium on the PATH, without a display.
"""

import argparse
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

SETTLED = "(window.replay || window.view)?.splats.settled && !viewer.needs_render"
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def opened(page: Path, width: int, height: int) -> Iterator[Page]:
    """A page in a browser of that size [px]."""
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.set_default_timeout(300_000)
        tab.goto(page.resolve().as_uri())
        tab.wait_for_function(SETTLED)
        yield tab
        browser.close()


def photograph(tab: Page, view: str, time: float) -> Image.Image:
    """A view of the page at a time [s]."""
    tab.evaluate(f"() => {{ replay.look('{view}'); replay.seek({time}); }}")
    tab.wait_for_function(SETTLED)
    return Image.open(BytesIO(tab.screenshot())).convert("RGB")


def photograph_place(tab: Page, distances: bool) -> Image.Image:
    """The page of a place as it opens, with a captured image, or with distances."""
    script = "view.switches.slice(true)" if distances else "view.choose(27)"
    tab.evaluate(f"() => {{ {script}; }}")
    tab.wait_for_timeout(1000)
    tab.wait_for_function(SETTLED)
    return Image.open(BytesIO(tab.screenshot())).convert("RGB")


def write(page: Path, out: Path, time: float) -> None:
    """Two views of the page at a time [s], side by side; of a place, with and without distances."""
    with opened(page, 1000, 620) as tab:
        if tab.evaluate("() => 'view' in window"):
            views = [photograph_place(tab, distances) for distances in (False, True)]
        else:
            views = [photograph(tab, view, time) for view in ("overview", "chase")]
    picture = Image.fromarray(np.hstack([np.asarray(view) for view in views]))
    picture.resize((1600, 496), Image.Resampling.LANCZOS).save(out, quality=82)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--time", type=float, default=6.0, help="[s] (%(default)s)")
    options = parser.parse_args()
    write(options.page, options.out, options.time)
