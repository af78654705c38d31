"""From a capture, a mesh or a generated world to a scene folder with metrics on the frames of the
capture: `metrics.json` and `views.png`."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.analysis import figures
from splatpilot.analysis.figures import Panel, Scale, colorize
from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.observed_routes import ObservedViews
from splatpilot.systems.common.files import locked_folder, require_unused, write_text
from splatpilot.systems.common.processes import require_renderer
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import bounded, require
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.splats.background import RenderedView, put_behind
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.capture import Capture, CaptureFrame, shrink, shrink_factor
from splatpilot.training.captures.capture_registry import read_capture, read_scene_capture
from splatpilot.training.captures.check import doubts
from splatpilot.training.captures.render import RenderConfig
from splatpilot.training.reconstruction.checkpoint import kept_work, work_folder
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.metrics import (
    Lpips,
    ViewMetrics,
    fit_exposure,
    has_true_depth,
    mean_metric,
    measure_view,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, seen_pixels
from splatpilot.training.reconstruction.reconstruct import ReconstructSummary, reconstruct
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer

METRICS = "metrics.json"
VIEWS = "views.png"
NAMES = {
    "psnr_db": ("PSNR [dB]", "{:.2f}"),
    "psnr_on_black_db": ("PSNR on black [dB]", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS-squeeze", "{:.3f}"),
    "depth_mae_m": ("depth MAE [m]", "{:.3f}"),
    "depth_relative": ("depth error, relative", "{:.2%}"),
    "floater_fraction": ("floaters", "{:.2%}"),
    "hole_fraction": ("holes", "{:.2%}"),
    "unseen_fraction": ("left out as unseen", "{:.2%}"),
}
"""Titles and formats of metrics in tables."""
_MAX_UNSEEN = 0.5  # of the pixels of the default flight, without a warning
_MAX_ROWS = 4  # of the image grid
_ERROR_LIMIT = 0.05  # brightest color of depth errors, as a fraction of the median depth
_POSES = 36  # along the default flight


@dataclass(frozen=True)
class SceneMetrics:
    """Metrics of a scene on frames of its capture."""

    held_out: bool  # the frames were not fitted
    width: int  # [px], of the frames, shrunk as for reconstruction
    height: int
    frames: dict[int, ViewMetrics]  # over pixels that a fitted frame saw, with fitted exposure
    strict_width: int  # [px], of the frames as captured
    strict_height: int
    strict_frames: dict[int, ViewMetrics]  # over all pixels in that size, with predicted exposure
    lpips_missing: str  # reason for missing LPIPS
    flight_unseen_fraction: float | None  # see `unseen_fraction`

    def mean(self, name: str) -> float | None:
        """Returns the mean of a metric over the frames that have it, or None."""
        return mean_metric(self.frames.values(), name)[0]

    def as_json(self) -> dict:
        """Returns the content of `metrics.json`."""
        holes = (frame.hole_fraction for frame in self.frames.values())
        return {
            **{name: self.mean(name) for name in NAMES},
            "counts": {name: mean_metric(self.frames.values(), name)[1] for name in NAMES},
            "strict": {name: mean_metric(self.strict_frames.values(), name)[0] for name in NAMES},
            "worst_hole_fraction": max((f for f in holes if f is not None), default=None),
            "held_out": self.held_out,
            "width": self.width,
            "height": self.height,
            "strict_width": self.strict_width,
            "strict_height": self.strict_height,
            "lpips_missing": self.lpips_missing,
            "flight_unseen_fraction": self.flight_unseen_fraction,
            "frames": {str(i): asdict(frame) for i, frame in self.frames.items()},
            "strict_frames": {str(i): asdict(f) for i, f in self.strict_frames.items()},
        }

    def __str__(self) -> str:
        kind = "held-out frames" if self.held_out else "frames the scene was made from"
        content = self.as_json()
        lines = [
            f"{'measured on':<22} {len(self.frames)} {kind}, {self.width} x {self.height}",
            f"{'':<22} {'seen pixels, gain fitted':<26} strict: all pixels, nothing fitted, "
            f"{self.strict_width} x {self.strict_height}",
        ]
        for name, (title, form) in NAMES.items():
            cell, count = format_metric(content[name], form), content["counts"][name]
            if 0 < count < len(self.frames):
                cell += f" ({count} of {len(self.frames)} frames)"
            strict = format_metric(content["strict"][name], form)
            lines.append(f"{title:<22} {cell:<26} {strict}")
        worst = format_metric(content["worst_hole_fraction"], NAMES["hole_fraction"][1])
        lines.append(f"{'holes, worst frame':<22} {worst}")
        unseen = self.flight_unseen_fraction
        lines.append(f"{'unseen in flight':<22} {format_metric(unseen, '{:.1%}')}")
        if unseen is not None and unseen > _MAX_UNSEEN:
            lines.append(
                "warning: a flight from the default start to the default goal looks mostly into "
                "space that no camera saw; capture it looking ahead along such routes"
            )
        if self.lpips_missing:
            lines.append(f"no LPIPS: {self.lpips_missing}")
        return "\n".join(lines)


def format_metric(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def read_metrics(scene: Path) -> SceneMetrics | None:
    """Reads `metrics.json` of a scene folder; None without the file."""
    file = scene / METRICS
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text())
        values = {field.name: content[field.name] for field in fields(SceneMetrics)}
        names = [field.name for field in fields(ViewMetrics)]
        for name in ("frames", "strict_frames"):
            frames = values[name].items()
            values[name] = {int(i): ViewMetrics(**{n: f[n] for n in names}) for i, f in frames}
        return SceneMetrics(**values)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: {error!r}; delete the file and measure again") from error


class SceneViews:
    """A scene folder and its capture, by default that of `scene.yaml`."""

    def __init__(self, scene: Path, capture: Capture | None = None):
        self.metadata: scene_folder.SceneMetadata = scene_folder.read_scene_metadata(scene)
        self.background = scene_folder.read_background(scene, self.metadata)
        self.capture = capture = capture or read_scene_capture(scene, self.metadata)
        fitted = len(self.metadata.gains) or len(capture)
        valid = fitted == len(capture) > max(self.metadata.held_out, default=0)
        remedy = "the capture has changed since; reconstruct the scene again"
        require(valid, f"frames of {capture.source}", f"those of {scene}", len(capture), remedy)
        held_out = set(self.metadata.held_out)
        self.fitted = [i for i in range(len(capture)) if i not in held_out]
        self.factor = shrink_factor(capture.width, self.metadata.image_width)
        self.renderer = SceneRenderer(
            scene_folder.read_gaussians(scene), self.metadata.representation
        )

    @property
    def measured(self) -> Sequence[int]:
        """The frames that measure the scene: held-out ones, or every eighth."""
        return self.metadata.held_out or range(0, len(self.capture), 8)

    def frame(self, i: int) -> CaptureFrame:
        """Returns frame i of the capture in the size of the reconstruction."""
        return shrink(self.capture.frame(i), self.factor)

    def panels(
        self, frame: CaptureFrame, depths: Scale, errors: Scale, labels: tuple[str, str]
    ) -> list[Panel]:
        """Returns panels of a frame, its view, true and rendered depth, and labeled depth error."""
        view, truth = self.render(frame), frame.image / 255
        image, _ = fit_exposure(view.color, truth, self.metadata.vignetting, frame.valid)
        known = has_true_depth(frame.depth)
        error = np.abs(view.depth - np.where(known, frame.depth, 0))
        return [
            Panel(truth),
            Panel(image, labels[0]),
            Panel(colorize(frame.depth, depths, known)),
            Panel(colorize(view.depth, depths, view.alpha > 0)),
            Panel(colorize(error, errors, known), labels[1]),
        ]

    def render(self, frame: CaptureFrame) -> RenderedView:
        """Renders the scene from the camera of `frame`."""
        view = self._render_on_black(frame)
        return put_behind(view, self.background, frame.slopes, frame.X_WC)

    def measure(self, frame: CaptureFrame, **options: Any) -> ViewMetrics:
        """Compares frame and scene, see `measure_view` for the options."""
        on_black, vignetting = self._render_on_black(frame), self.metadata.vignetting
        return measure_view(on_black, self.background, frame, vignetting, **options)

    def _render_on_black(self, frame: CaptureFrame) -> RenderedView:
        height, width = frame.depth.shape
        return self.renderer.render(frame.K, width, height, frame.X_WC)


def measure_scene(scene: Path, capture: Capture | None = None) -> SceneMetrics:
    """Measures a scene on `SceneViews.measured`; writes `metrics.json` and `views.png` into it."""
    views = SceneViews(scene, capture)
    try:
        lpips, missing = Lpips(), ""
    except (OSError, ValueError) as error:
        lpips, missing = None, str(error)
    fitted = [ThinnedFrame.of(views.frame(i)) for i in views.fitted]
    gains = views.metadata.gains or [1.0] * len(views.capture)
    frames, strict = {}, {}
    for i in Progress(views.measured, "measuring frames", unit="frame"):
        whole = views.capture.frame(i)
        frame = shrink(whole, views.factor)
        frames[i] = views.measure(frame, seen=seen_pixels(frame, fitted), lpips=lpips)
        strict[i] = views.measure(whole, lpips=lpips, gain=gains[i])
    width, height = views.capture.width, views.capture.height
    metrics = SceneMetrics(
        held_out=bool(views.metadata.held_out),
        width=width // views.factor,
        height=height // views.factor,
        frames=frames,
        strict_width=width,
        strict_height=height,
        strict_frames=strict,
        lpips_missing=missing,
        flight_unseen_fraction=unseen_fraction(scene),
    )
    _write_views(scene / VIEWS, views, metrics)
    write_text(scene / METRICS, json.dumps(metrics.as_json(), indent=2))
    return metrics


def run(scene: Path, overwrite: bool = False) -> SceneMetrics:
    """Measures a scene folder, see `measure_scene`, and prints its origin and the table."""
    require_unused(scene / METRICS, overwrite)
    metadata = scene_folder.read_scene_metadata(scene)
    metrics = measure_scene(scene)
    if metadata.provenance:
        print(f"{'made from':<22} {metadata.provenance}")
    print(f"{'seen free [m^3]':<22} {metadata.observed_free_volume:.1f}")
    if metadata.gains:
        low, high = min(metadata.gains), max(metadata.gains)
        print(f"{'image gains':<22} {low:.3f} to {high:.3f}")
    print(metrics)
    return metrics


def _write_views(path: Path, views: SceneViews, metrics: SceneMetrics) -> None:
    indices = list(metrics.frames)
    picked = sorted({indices[k] for k in np.linspace(0, len(indices) - 1, _MAX_ROWS).astype(int)})
    frames = [views.frame(i) for i in picked]
    true = [frame.depth for frame in frames if has_true_depth(frame.depth).any()]
    depths = figures.depth_scale(true or [views.render(frame).depth for frame in frames])
    middle = np.median([np.median(frame.depth) for frame in frames])
    errors = figures.error_scale(_ERROR_LIMIT * float(middle) if 0 < middle < np.inf else 0.1)
    rows = []
    for i, frame in zip(picked, frames, strict=True):
        found = metrics.frames[i]
        mae = "" if found.depth_mae_m is None else f"{100 * found.depth_mae_m:.1f} cm"
        labels = format_metric(found.psnr_db, "{:.1f} dB"), mae
        rows.append(views.panels(frame, depths, errors, labels))
    columns = ["captured", "scene", "captured depth", "depth of the scene", "depth error"]
    scales = [depths] + [errors] * (len(rows) - 1)
    if not true:
        kept = 0, 1, 3
        columns, rows = [columns[k] for k in kept], [[row[k] for k in kept] for row in rows]
        scales = [depths]
    figures.write_grid(path, rows, columns, [f"frame {i}" for i in picked], scales)


def unseen_fraction(scene: Path) -> float | None:
    """Returns the mean fraction of `ObservedViews` along the route to the goal, if there is one."""
    metadata = scene_folder.read_scene_metadata(scene)
    if not metadata.metric:
        return None
    world = scene_folder.read_scene_folder(scene)
    try:
        toa = time_of_arrival(world.esdf.conservative(), world.p_WG)
    except InfeasibleFlightError:
        return None
    if not toa.is_reachable(world.p_WS):
        return None
    if world.observations is None and not metadata.frontier:
        return 0.0
    # Points beyond the goal are the goal, without direction.
    reach = float(toa.value(world.p_WS))  # [m] at 1 m/s, at least the length of the route
    points, directions = toa.path(world.p_WS, np.linspace(0.0, reach, 8 * _POSES))
    before = np.flatnonzero(np.linalg.norm(directions[:, :2], axis=1) > 0.0)
    if not len(before):
        return None
    chosen = before[np.linspace(0, len(before) - 1, _POSES).astype(int)]
    views = ObservedViews(world)
    yaws = np.arctan2(directions[chosen, 1], directions[chosen, 0])
    ahead = (views.ahead(p, yaw) for p, yaw in zip(points[chosen], yaws, strict=True))
    return float(np.mean(list(ahead)))


@dataclass
class RenderedSceneConfig(ReconstructConfig):
    """Settings of a mesh or a generated world: its capture and reconstruction."""

    render: RenderConfig = field(default_factory=RenderConfig)
    voxel_size: float = bounded(0.1, "[0, inf) m")
    """[m], of the distance field; the planner searches a hall in seconds."""

    def reconstruct(self) -> ReconstructConfig:
        """Returns the part of the reconstruction."""
        rest = {name: value for name, value in vars(self).items() if name != "render"}
        return ReconstructConfig(**rest)


def make_rendered_scene(
    *,
    world: str | Path,
    out: str | Path,
    config: RenderedSceneConfig,
    seed: int = 0,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMetrics]:
    """Renders a mesh or a scenario's generated world to `out/capture`, if that is not there, and
    makes the scene `out` of it; see `render_capture.run` and `make_scene`."""
    scene_folder.check_scene_target(out)
    capture = Path(out) / scene_folder.CAPTURE
    render_capture.run(world=world, out=capture, config=config.render, seed=seed)
    options = {"restart": restart, "overwrite": overwrite}
    return make_scene(capture=capture, out=out, config=config.reconstruct(), **options)


def make_scene(
    *,
    capture: str | Path,
    out: str | Path,
    config: ReconstructConfig,
    restart: bool = False,
    overwrite: bool = False,
) -> tuple[ReconstructSummary, SceneMetrics]:
    """Reconstructs the capture in a folder as the scene folder `out`, measures it and prints the
    results; see `reconstruct` and `measure_scene`."""
    out = Path(out)
    # Before photographs are registered, which takes minutes.
    config.validate()
    require_renderer(config.device)
    scene_folder.check_scene_target(out)
    if (out / VIEWS).exists():
        require_unused(out, overwrite)
    opened = read_capture(capture, config.capture)
    if (out / "scene.yaml").is_file() and not (out / VIEWS).exists():
        about = scene_folder.read_scene_metadata(out)
        made_from = about.capture, about.capture_settings
        if made_from != (opened.folder, opened.config.settings()):  # not to be measured only
            require_unused(out, overwrite)
    doubted = doubts(opened)
    for doubt in doubted:  # at once, and again in the summary
        print(f"warning: {doubt}", flush=True)
    with locked_folder(work_folder(out)):
        with resumable(lambda: kept_work(out)):
            summary = reconstruct(opened, out, config, restart=restart)
        summary = replace(summary, warnings=(*doubted, *summary.warnings))
        print(summary)
        measure = f"`splatpilot scene measure {out}` measures it"
        with resumable(lambda: f"{out} is made, but not measured; {measure}"):
            metrics = measure_scene(out, opened)
        print(metrics)
    return summary, metrics
