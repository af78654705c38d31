"""`splatpilot view`: pages of scenes, maps, captures and generated worlds."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Rgba
from scipy.spatial import KDTree

from splatpilot.diagrams.flight.flight_diagram import empty_meshcat
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_scenario,
    start_position,
)
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.file_worlds import OCTOMAP
from splatpilot.diagrams.worlds.scene_folder import (
    read_scene,
    read_scene_folder,
    read_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world, scene_config
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import require_unused, require_writable_folder, write_text
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_splats, sog_meta
from splatpilot.systems.visualization.meshcat_drawing import (
    GOAL_COLOR,
    MARKER_RADIUS,
    START_COLOR,
    draw_box,
    draw_goal,
)
from splatpilot.systems.visualization.pages import CapturedImages, ViewerScene, scene_page
from splatpilot.training.captures.capture import Capture, depth_points
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture, read_scene_capture
from splatpilot.training.captures.photographs import is_video

_SCENARIOS = {".yaml", ".yml"}
_MAX_IMAGES = 60
_IMAGE_WIDTH = 480  # [px]
_HEADROOM = 0.15  # [-] fraction of the height that is shown above the cameras
_BOUNDS = "#fff", "bounds"
_MAX_POINTS, _MAX_GAUSSIANS = 2_000_000, 200_000  # of a capture
_SPREAD = 0.6  # standard deviation of a Gaussian over the distance to its neighbors


def run(
    *,
    what: str,
    out: Path | None = None,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Writes a page of a scene folder, a file of Gaussians, an OctoMap, a capture or a scenario, by
    default `out/view/NAME.html`, or `NAME-SEED.html` of a generated world. `overrides` are
    FIELD=VALUE of the scenario, or of the capture's `CaptureConfig`."""
    path = Path(what)
    name = path.resolve().name if path.is_dir() else path.stem
    scenario = generated_scenario(path, seed, overrides)
    if scenario is not None:
        name = f"{name}-{scenario.seed:03d}"
    out = out or Path("out/view") / f"{name}.html"
    require_unused(out, overwrite)
    is_scene = (path / "scene.yaml").is_file()
    if scenario is not None:
        shown = _generated(scenario)
    elif not is_scene and not _may_hold_gaussians(path):
        shown = _capture(path, overrides)
    else:
        if overrides:
            got = f"got {overrides[0]}; leave it out"
            raise ValueError(f"--set must be of a scenario or a capture, {got}")
        shown = _scene(path) if is_scene else _gaussians(path)
    require_writable_folder(out.absolute().parent)
    meshcat = empty_meshcat(shown.background)
    draw_box(meshcat, "/splatpilot/bounds", shown.lower_W, shown.upper_W)
    for p_W, end, color in zip(
        shown.ends or (), ("start", "goal"), (START_COLOR, GOAL_COLOR), strict=False
    ):
        draw_goal(meshcat, f"/splatpilot/{end}", p_W, MARKER_RADIUS, color)
    write_text(out, scene_page(meshcat.StaticHtml(), shown))
    print(f"Wrote {out}, a page for any browser")
    return out


def generated_scenario(path: Path, seed: int | None, overrides: Sequence[str]) -> Scenario | None:
    """Reads a scenario, or makes that of an OctoMap; None for others, which have no seed."""
    if path.is_dir() or _may_hold_gaussians(path) or is_video(path):
        require(seed is None, "--seed", "of a generated world", seed, f"leave it out for {path}")
        return None
    if path.suffix.lower() == OCTOMAP:
        scenario = load_config(Scenario(world=scene_config(path)), None, list(overrides))
    else:
        scenario = load_config(Scenario(), scenario_file(str(path)), list(overrides))
    return scenario if seed is None else replace(scenario, seed=seed)


def _may_hold_gaussians(path: Path) -> bool:
    other = path.suffix.lower() in _SCENARIOS | {OCTOMAP} or is_video(path)
    return sog_meta(path) is not None or (path.is_file() and not other)


def _generated(scenario: Scenario) -> ViewerScene:
    scenario.validate()
    scenario = sample_scenario(scenario)
    world = make_world(scenario.world, scenario.seed)
    ends = start_position(scenario, world), goal_position(scenario, world)
    return _show_world(world, f"{world.name}, seed {scenario.seed}", ends)


def _scene(path: Path) -> ViewerScene:
    metadata = read_scene_metadata(path)
    world = read_scene_folder(path, metric=False)
    notes, images = [], None
    try:
        images = _captured_images(read_scene_capture(path, metadata))
    except (ValueError, OSError, ModuleNotFoundError) as error:
        notes.append(f"Captured images are not shown: {error}.")
    notes += _origin_notes(metadata.origin)
    if not metadata.metric:
        notes.append("The unit of length is unknown; measure a known length.")
    ends = (world.p_WS, world.p_WG) if metadata.metric else None
    target = shlex.quote(f"{path}-scaled")
    return replace(
        _show_world(world, world.name, ends, images),
        beyond=False,
        metric=metadata.metric,
        notes=notes,
        scale_command=f"splatpilot scene scale {shlex.quote(str(path))} --out {target}",
    )


def _gaussians(path: Path) -> ViewerScene:
    """Shows a file of Gaussians, with distances if its world can be made."""
    try:
        world = read_scene(path)
    except ValueError as error:
        gaussians = read_splats(path)
        lower_W, upper_W = _bounds(gaussians.means)
        notes = [f"Without distances, start and goal: {error}.", *_origin_notes(gaussians.origin)]
        bounds = lower_W, upper_W, float(upper_W[2])
        black = (0.0, 0.0, 0.0)
        return ViewerScene(path.stem, gaussians, black, *bounds, legend=[_BOUNDS], notes=notes)
    shown = _show_world(world, world.name, (world.p_WS, world.p_WG))
    return replace(shown, notes=_origin_notes(world.gaussians.origin))


def _origin_notes(origin: Sequence[float]) -> list[str]:
    text = ", ".join(f"{x:.10g}" for x in origin)
    return [f"Positions are relative to {text} of the files."] if any(origin) else []


def _capture(path: Path, overrides: Sequence[str]) -> ViewerScene:
    fields = [override.removeprefix("capture.") for override in overrides]
    capture = read_capture(path, load_config(CaptureConfig(), overrides=fields))
    gaussians = capture_gaussians(capture, _shown_frames(capture))
    if gaussians is None:
        raise ValueError(f"{path} has neither depth nor points to view; reconstruct it first")
    images = _captured_images(capture)
    lower_W, upper_W = _bounds(gaussians.means)
    notes = ["Points of the capture; `splatpilot reconstruct` makes surfaces of them."]
    notes += [f"{note[0].upper()}{note[1:]}." for note in capture.notes]
    if not capture.metric:
        notes.append("The unit of length is unknown; set capture.scale.")
    return ViewerScene(
        name=capture.name,
        gaussians=gaussians,
        background=(0.1, 0.1, 0.1),
        lower_W=np.minimum(lower_W, images.p_WCs.min(axis=0)),
        upper_W=np.maximum(upper_W, images.p_WCs.max(axis=0)),
        height=_shown_height(lower_W, upper_W, images.p_WCs),
        images=images,
        metric=capture.metric,
        legend=[_BOUNDS],
        notes=notes,
    )


def _show_world(
    world: World,
    name: str,
    ends: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    images: CapturedImages | None = None,
) -> ViewerScene:
    lower_W, upper_W = world.esdf.lower_W, world.esdf.upper_W
    p_WQ = images.p_WCs if images else np.array([world.p_WS, world.p_WG])
    legend = [_BOUNDS]
    if ends is not None:
        legend += [(_css(START_COLOR), "start"), (_css(GOAL_COLOR), "goal")]
    return ViewerScene(
        name=name,
        gaussians=world.gaussians,
        background=world.background,
        lower_W=lower_W,
        upper_W=upper_W,
        height=_shown_height(lower_W, upper_W, p_WQ),
        field=world.esdf,
        num_frontier=world.num_frontier,
        ends=ends,
        images=images,
        legend=legend,
    )


def _css(color: Rgba) -> str:
    return f"rgb({255 * color.r():.0f}, {255 * color.g():.0f}, {255 * color.b():.0f})"


def _bounds(p_WQ: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Computes the box of points (N, 3) [m] without outliers."""
    lower_W, upper_W = np.percentile(p_WQ.astype(float), [1, 99], axis=0)
    return lower_W, upper_W


def _shown_height(lower_W: NDArray, upper_W: NDArray, p_WQ: NDArray) -> float:
    """Returns a height [m] above most points (N, 3) and, if possible, below the ceiling."""
    headroom = _HEADROOM * (upper_W[2] - lower_W[2])
    return min(float(np.median(p_WQ[:, 2]) + headroom), float(upper_W[2]))


def _shown_frames(capture: Capture) -> list[int]:
    count = min(len(capture), _MAX_IMAGES)
    return np.linspace(0, len(capture) - 1, count).round().astype(int).tolist()


def _captured_images(capture: Capture) -> CapturedImages:
    frames = _shown_frames(capture)
    width = min(_IMAGE_WIDTH, capture.width)
    size = width, round(capture.height * width / capture.width)

    def load_small(i: int) -> NDArray[np.uint8]:
        image = cv2.resize(capture.load_image(i), size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)

    names = capture.frame_names or [f"frame {i}" for i in range(len(capture))]
    return CapturedImages(
        X_WCs=[capture.X_WCs[i] for i in frames],
        names=[names[i] for i in frames],
        images=[load_small(i) for i in frames],
        K=capture.K,
        width=capture.width,
        height=capture.height,
    )


def capture_gaussians(capture: Capture, frames: Sequence[int]) -> GaussianScene | None:
    """Returns round Gaussians at the measured depth of some frames or, without depth, at the points
    of the registration; None without either."""
    if capture.has_depth:
        # A grid of pixels of each frame.
        pixels = len(frames) * capture.width * capture.height
        step = max(1, int(np.ceil(np.sqrt(pixels / _MAX_POINTS))))
        parts = []
        for i in Progress(frames, "reading depth", unit="frame", delay=2.0):
            frame = capture.frame(i)
            p_CQ, rows, columns = depth_points(frame.K, frame.depth, step)
            p_WQ = frame.X_WC.multiply(p_CQ.T).T
            parts.append(np.column_stack([p_WQ, frame.image[rows, columns] / 255]))
        points, colors = np.split(np.concatenate(parts), 2, axis=1)
    elif capture.points is not None:
        points, colors = capture.points.p_WQ, capture.points.colors
    else:
        return None
    if len(points) < 2:
        return None
    kept = _thin(points)
    points, colors = points[kept], colors[kept]
    distances, _ = KDTree(points).query(points, k=2)
    # A point far from others is not larger than they are.
    size = np.minimum(distances[:, 1], 4 * np.median(distances[:, 1])) + 1e-6
    return GaussianScene.from_colors(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        _SPREAD * size[:, None].repeat(3, axis=1),
        np.full(len(points), 0.95),
        colors,
    )


def _thin(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns the first point in each cell of the finest grid with few occupied cells."""
    lower = points.min(axis=0)
    # Few points far away must not make the cells large.
    extent = float(np.percentile(np.ptp(points, axis=0), 50)) or 1.0
    edge = extent / 4096
    while True:
        cells = np.floor((points - lower) / edge).astype(np.int64)
        _, first = np.unique((cells[:, 0] << 42) ^ (cells[:, 1] << 21) ^ cells[:, 2], True)
        if len(first) <= _MAX_GAUSSIANS:
            return np.sort(first)
        edge *= 1.3
