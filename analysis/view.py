"""Any place as a page to look at, or served: a scene, a PLY, a capture or a generated world."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Rgba

from splatpilot.diagrams.flight.blocks import goal_position
from splatpilot.diagrams.flight.flight_diagram import empty_meshcat
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.octomap_world import OCTOMAP
from splatpilot.diagrams.worlds.scene_folder import (
    FRONTIER,
    read_scene,
    read_scene_folder,
    read_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world, scene_config
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import (
    require_unused,
    require_writable_folder,
    written_atomically,
)
from splatpilot.systems.splats.splat_files import read_ply, read_splats
from splatpilot.systems.visualization.meshcat_drawing import (
    GOAL_COLOR,
    MARKER_RADIUS,
    START_COLOR,
    draw_box,
    draw_goal,
)
from splatpilot.systems.visualization.pages import CapturedImages, ViewerScene, scene_page
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture, read_capture_of
from splatpilot.training.captures.colmap import is_video
from splatpilot.training.captures.render import capture_gaussians

_SCENARIOS = {".yaml", ".yml"}
_MAX_IMAGES = 60
_IMAGE_WIDTH = 480  # [px]
_HEADROOM = 0.15  # of the place's height, left above what is of interest
_BOUNDS = "#fff", "bounds"


def shown_place(what: str, seed: int | None, overrides: Sequence[str]) -> ViewerScene:
    """What is shown of a place.

    Args:
        what: a scene folder, a file of Gaussians, an OctoMap, the folder of a capture, a video,
            or a scenario.
        seed: of a generated world; that of its scenario if None.
        overrides: FIELD=VALUE of the scenario, or of the capture's `CaptureConfig`.

    Raises:
        FileNotFoundError, ValueError, OSError: if there is no such place or it is damaged, or
            settings are given of what has none.
    """
    path = Path(what)
    if (scenario := generated_scenario(path, seed, overrides)) is not None:
        return _generated(scenario)
    if seed is not None:
        raise ValueError(f"--seed {seed}: {what} is no generated world; leave the seed out")
    scene = (path / "scene.yaml").is_file()
    if not scene and not _may_hold_gaussians(path):
        return _capture(path, overrides)
    if overrides:
        raise ValueError(f"--set {overrides[0]}: a finished scene has no settings; leave it out")
    return _scene(path) if path.is_dir() else _gaussians(path)


def generated_scenario(path: Path, seed: int | None, overrides: Sequence[str]) -> Scenario | None:
    """The scenario whose generated world or OctoMap is meant, or None for a folder, a file of
    Gaussians or a video.

    Raises:
        FileNotFoundError, ValueError: see `load_config`.
    """
    if path.is_dir() or _may_hold_gaussians(path) or is_video(path):
        return None
    if path.suffix.lower() == OCTOMAP:
        scenario = load_config(Scenario(world=scene_config(path)), None, list(overrides))
    else:
        scenario = load_config(Scenario(), scenario_file(str(path)), list(overrides))
    return scenario if seed is None else replace(scenario, seed=seed)


def _may_hold_gaussians(path: Path) -> bool:
    """Whether it is no file of any other kind that is shown."""
    suffix = path.suffix.lower()
    return path.is_file() and suffix not in _SCENARIOS | {OCTOMAP} and not is_video(path)


def _generated(scenario: Scenario) -> ViewerScene:
    scenario.validate()
    world = make_world(scenario.world, scenario.seed)
    start = world.p_WS if scenario.start is None else np.asarray(scenario.start, dtype=float)
    ends = start, goal_position(scenario, world)
    return _place_of(world, f"{world.name}, seed {scenario.seed}", ends)


def _scene(path: Path) -> ViewerScene:
    metadata = read_scene_metadata(path)
    world = read_scene_folder(path, metric=False)
    notes, images = [], None
    try:
        images = _images_of(read_capture_of(path, metadata))
    except (ValueError, OSError, ModuleNotFoundError) as error:
        notes.append(f"Captured images are not shown: {error}.")
    if any(metadata.origin):
        notes.append(_relative(metadata.origin))
    if not metadata.metric:
        notes.append("Its unit of length is unknown. Measure what you know the length of.")
    ends = (world.p_WS, world.p_WG) if metadata.metric else None
    target = shlex.quote(f"{path}-scaled")
    return replace(
        _place_of(world, world.name, ends, images),
        num_frontier=len(read_ply(path / FRONTIER)) if metadata.frontier else 0,
        beyond=False,
        metric=metadata.metric,
        notes=notes,
        scale_command=f"splatpilot scene scale {shlex.quote(str(path))} --out {target}",
    )


def _gaussians(path: Path) -> ViewerScene:
    try:
        world = read_scene(path)
    except ValueError as error:
        gaussians = read_splats(path)
        lower_W, upper_W = _bounds(gaussians.means)
        notes = [f"Without distances, start and goal: {error}."]
        if any(gaussians.origin):
            notes.append(_relative(gaussians.origin))
        return ViewerScene(
            path.stem,
            gaussians,
            (0.0, 0.0, 0.0),
            lower_W,
            upper_W,
            float(upper_W[2]),
            legend=[_BOUNDS],
            notes=notes,
        )
    place = _place_of(world, world.name, (world.p_WS, world.p_WG))
    if any(world.gaussians.origin):
        place = replace(place, notes=[_relative(world.gaussians.origin)])
    return place


def _relative(origin: Sequence[float]) -> str:
    return f"Positions are relative to {', '.join(f'{x:.10g}' for x in origin)} of the files."


def _capture(path: Path, overrides: Sequence[str]) -> ViewerScene:
    capture = read_capture(path, load_config(CaptureConfig(), overrides=list(overrides)))
    gaussians = capture_gaussians(capture, _some(capture))
    if gaussians is None:
        raise ValueError(
            f"{path}: neither depth nor points are known of this capture, so there is nothing to "
            "look at; reconstruct it first"
        )
    images = _images_of(capture)
    lower_W, upper_W = _bounds(gaussians.means)
    notes = ["Points as they were captured; `splatpilot reconstruct` makes surfaces of them."]
    notes += [f"{note[0].upper()}{note[1:]}." for note in capture.notes]
    if not capture.metric:
        notes.append("Its unit of length is unknown; it is told by capture.scale.")
    return ViewerScene(
        name=capture.name,
        gaussians=gaussians,
        background=(0.1, 0.1, 0.1),
        lower_W=np.minimum(lower_W, images.p_WCs.min(axis=0)),
        upper_W=np.maximum(upper_W, images.p_WCs.max(axis=0)),
        height=_height(lower_W, upper_W, images.p_WCs),
        images=images,
        metric=capture.metric,
        legend=[_BOUNDS],
        notes=notes,
    )


def _place_of(
    world: World,
    name: str,
    ends: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    images: CapturedImages | None = None,
) -> ViewerScene:
    lower_W, upper_W = world.esdf.lower_W, world.esdf.upper_W
    seen = images.p_WCs if images else np.array([world.p_WS, world.p_WG])
    legend = [_BOUNDS]
    if ends is not None:
        legend += [(_css(START_COLOR), "start"), (_css(GOAL_COLOR), "goal")]
    return ViewerScene(
        name=name,
        gaussians=world.gaussians,
        background=world.background,
        lower_W=lower_W,
        upper_W=upper_W,
        height=_height(lower_W, upper_W, seen),
        field=world.esdf,
        ends=ends,
        images=images,
        legend=legend,
    )


def _css(color: Rgba) -> str:
    return f"rgb({255 * color.r():.0f}, {255 * color.g():.0f}, {255 * color.b():.0f})"


def _bounds(p_WQ: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box of nearly all points: a few stray ones are left out."""
    lower_W, upper_W = np.percentile(p_WQ.astype(float), [1, 99], axis=0)
    return lower_W, upper_W


def _height(lower_W: NDArray, upper_W: NDArray, p_WQ: NDArray) -> float:
    """Below which most points of interest (N, 3) [m] are, but hardly a ceiling."""
    headroom = _HEADROOM * (upper_W[2] - lower_W[2])
    return min(float(np.median(p_WQ[:, 2]) + headroom), float(upper_W[2]))


def _some(capture: Capture) -> list[int]:
    """Frames that are shown, evenly chosen."""
    count = min(len(capture), _MAX_IMAGES)
    return np.linspace(0, len(capture) - 1, count).round().astype(int).tolist()


def _images_of(capture: Capture) -> CapturedImages:
    frames = _some(capture)
    width = min(_IMAGE_WIDTH, capture.width)
    size = width, round(capture.height * width / capture.width)

    def small(i: int) -> NDArray[np.uint8]:
        image = cv2.resize(capture.load_image(i), size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)

    names = capture.frame_names or [f"frame {i}" for i in range(len(capture))]
    return CapturedImages(
        X_WCs=[capture.X_WCs[i] for i in frames],
        names=[names[i] for i in frames],
        images=[small(i) for i in frames],
        K=capture.K,
        width=capture.width,
        height=capture.height,
    )


def run(
    *,
    what: str,
    out: Path | None = None,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Writes the page of a place, prints where, and returns that.

    Args:
        what: a scene folder, a PLY, the folder of a capture, or a scenario.
        out: the page; `out/view/NAME.html` if None, or `NAME-SEED.html` of a generated world.
        seed: of a generated world; that of its scenario if None.
        overrides: FIELD=VALUE of the scenario, or of the capture's `CaptureConfig`.
        overwrite: the page, if it is there.

    Raises:
        FileNotFoundError, ValueError, OSError: see `shown_place`; or if the page is there and not
            to be overwritten, or cannot be written.
    """
    path = Path(what)
    name = path.resolve().name if path.is_dir() else path.stem
    if (scenario := generated_scenario(path, seed, overrides)) is not None:
        name = f"{name}-{scenario.seed:03d}"
    out = out or Path("out/view") / f"{name}.html"
    require_unused(out, overwrite)
    place = shown_place(what, seed, overrides)
    require_writable_folder(out.absolute().parent)
    meshcat = empty_meshcat(place.background)
    draw_box(meshcat, "/splatpilot/bounds", place.lower_W, place.upper_W)
    for p, name, color in zip(
        place.ends or (), ("start", "goal"), (START_COLOR, GOAL_COLOR), strict=False
    ):
        draw_goal(meshcat, f"/splatpilot/{name}", p, MARKER_RADIUS, color)
    with written_atomically(out) as partial:
        partial.write_text(scene_page(meshcat.StaticHtml(), place))
    print(f"Wrote {out}, a page for any browser")
    return out
