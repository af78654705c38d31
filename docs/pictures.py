"""Makes the pictures of the documentation; `pictures.md` has the commands.

python docs/pictures.py moving out/house/flight.mp4 docs/flight.webp

Pages need Chromium on the PATH, but no display.
"""

import argparse
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraConfig

from splatpilot.diagrams.flight.blocks import MakeCamera
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.diagrams.worlds.world_registry import is_procedural, make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.noise import ObservationNoise, expose
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.splat_camera import color_pixels
from splatpilot.systems.vehicle.state import pose_from_state

Picture = np.ndarray  # (H, W, 3) uint8, red first


def frames(video: Path) -> list[Picture]:
    """Returns all frames of the video of a flight, color next to depth."""
    stream, found = cv2.VideoCapture(str(video)), []
    while (read := stream.read())[0]:
        found.append(read[1][..., ::-1])
    if not found:
        raise OSError(f"{video}: no frames")
    return found


def moments(video: Path, out: Path) -> None:
    """Saves three frames of a flight, color above depth."""
    images = frames(video)
    columns = [
        np.vstack(np.hsplit(images[round(fraction * (len(images) - 1))], 2))
        for fraction in (0.25, 0.5, 0.75)
    ]
    save(np.hstack(columns), out)


def moving(video: Path, out: Path) -> None:
    """Saves every third frame of a flight, color next to depth, as an animation."""
    rate = cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FPS) / 3
    first, *others = [Image.fromarray(shrink_to(frame, 800)) for frame in frames(video)[::3]]
    first.save(out, save_all=True, append_images=others, duration=1000 / rate, loop=0, quality=50)


def worlds(out: Path) -> None:
    """Saves a view of each generated world of the benchmark, from the start of its flights."""
    views = []
    for file in benchmark_scenarios().values():
        scenario = load_config(Scenario(), file)
        if not file.stem.startswith("P") or not is_procedural(scenario.world):
            continue
        scenario.camera.width, scenario.camera.height = 480, 180
        scenario.camera.focal = CameraConfig.FovDegrees(x=90.0)
        world = make_world(scenario.world, scenario.seed)
        X_WB = pose_from_state(sample_initial_state(scenario, world))
        color = MakeCamera(scenario, world).render(X_WB).color
        views.append((255 * color.clip(0, 1)).astype(np.uint8))
    pairs = zip(views[::2], views[1::2], strict=True)
    save(np.vstack([np.hstack(pair) for pair in pairs]), out)


def sensor(out: Path) -> None:
    """Saves three views of a room: plain, through a rolling shutter in a turn, and at night."""
    scenario = load_config(Scenario(), benchmark_scenarios()["P10"])
    world = make_world(scenario.world, scenario.seed)
    X_WB = pose_from_state(sample_initial_state(scenario, world))
    camera = make_onboard_camera(OnboardCamera(420, 280, readout=0.03), world)
    X_WB_start = X_WB @ RigidTransform(RollPitchYaw(-0.12, 0.0, 0.12), [-0.1, 0.0, 0.0])
    views = [camera.render(X_WB), camera.render(X_WB, None, X_WB_start)]
    still, rolled = (color_pixels(view.color) for view in views)
    night = ObservationNoise(exposure_error=4.0, full_well=8000.0, read_noise=8.0)
    grain = np.random.default_rng([0, 0]).standard_normal(still.shape)
    dim = expose(still.astype(float), night, -1.0, grain).astype(np.uint8)
    save(np.hstack([still, rolled, dim]), out)


def row(left: Path, right: Path, out: Path) -> None:
    """Saves two pictures next to each other."""
    save(shrink_to(np.hstack([load(left), load(right)]), 1280), out)


def column(upper: Path, lower: Path, out: Path) -> None:
    """Saves two pictures, one above the other."""
    pictures = [load(upper), load(lower)]
    width = max(picture.shape[1] for picture in pictures)
    padding = [((0, 0), (0, width - picture.shape[1]), (0, 0)) for picture in pictures]
    padded = [np.pad(p, pad, constant_values=255) for p, pad in zip(pictures, padding, strict=True)]
    save(np.vstack(padded), out)


def shrink(picture: Path, out: Path) -> None:
    """Saves a picture with at most the width of a page."""
    save(shrink_to(load(picture), 1500), out)


def flight(html: Path, out: Path) -> None:
    """Saves the page of a flight at 6 s, from above and following the vehicle."""
    scripts = [f"replay.look('{view}'); replay.seek(6)" for view in ("overview", "chase")]
    save(splat_page(html, scripts, height=700), out)


def scene(html: Path, out: Path) -> None:
    """Saves the page of a scene, with a captured image and with the distance field."""
    save(splat_page(html, ["view.choose(27)", "view.switches.slice(true)"]), out)


def splat_page(html: Path, scripts: list[str], height: int = 620) -> Picture:
    """Returns views of a page after each of the scripts, next to each other."""
    settled = "(window.replay || window.view)?.splats.settled && !viewer.needs_render"
    views = []
    with open_page(html, 1000, height) as tab:
        tab.wait_for_function(settled)
        for script in scripts:
            tab.evaluate(f"() => {{ {script}; }}")
            tab.wait_for_timeout(1000)
            tab.wait_for_function(settled)
            views.append(load(BytesIO(tab.screenshot())))
    return shrink_to(np.hstack(views), 1600)


@contextmanager
def open_page(html: Path, width: int, height: int) -> Iterator[Page]:
    """Opens a page in a browser of this size [px]."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"),
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.set_default_timeout(300_000)
        tab.goto(html.resolve().as_uri())
        yield tab
        browser.close()


def load(path: Path | BytesIO) -> Picture:
    return np.array(Image.open(path).convert("RGB"))


def shrink_to(picture: Picture, width: int) -> Picture:
    """Returns a picture with a width of at most `width` [px]."""
    scale = min(1.0, width / picture.shape[1])
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def save(picture: Picture, out: Path) -> None:
    Image.fromarray(picture).save(out, quality=82)


KINDS: dict[str, tuple[Callable[..., None], list[str]]] = {
    "moments": (moments, ["video"]),
    "moving": (moving, ["video"]),
    "worlds": (worlds, []),
    "sensor": (sensor, []),
    "row": (row, ["left", "right"]),
    "column": (column, ["upper", "lower"]),
    "shrink": (shrink, ["picture"]),
    "flight": (flight, ["html"]),
    "scene": (scene, ["html"]),
}
"""Functions by command, with the names of their input files."""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name, (make, files) in KINDS.items():
        kind = kinds.add_parser(name, help=make.__doc__)
        for file in [*files, "out"]:
            kind.add_argument(file, type=Path)
    return parser


if __name__ == "__main__":
    options = vars(make_parser().parse_args())
    KINDS[options.pop("kind")][0](**options)
