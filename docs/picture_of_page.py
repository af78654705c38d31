"""A picture of a flight's page: from above, and following the vehicle.

    splatpilot fly --seed 7 --out out/fly
    python docs/picture_of_page.py out/fly/flight.html docs/page.jpg

It needs a Chromium on the PATH, without a display.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

SIZE = {"width": 1000, "height": 620}
SETTLED = "window.replay && replay.splats.settled && !viewer.needs_render"
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def photograph(page: Path, time: float) -> np.ndarray:
    """(H, W, 3) uint8, blue first: two views of a page at a time [s], side by side."""
    pictures = []
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page(viewport=SIZE)
        tab.set_default_timeout(300_000)
        tab.goto(page.resolve().as_uri())
        for view in ("overview", "chase"):
            tab.wait_for_function(SETTLED)
            tab.evaluate(f"() => {{ replay.look('{view}'); replay.seek({time}); }}")
            tab.wait_for_function(SETTLED)
            shot = np.frombuffer(tab.screenshot(), np.uint8)
            pictures.append(cv2.imdecode(shot, cv2.IMREAD_COLOR))
        browser.close()
    return cv2.resize(np.hstack(pictures), None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--time", type=float, default=6.0, help="[s] (%(default)s)")
    options = parser.parse_args()
    picture = photograph(options.page, options.time)
    cv2.imwrite(str(options.out), picture, [cv2.IMWRITE_JPEG_QUALITY, 82])
