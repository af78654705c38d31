"""A scene folder measured on frames of its capture that had no part in making it."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from tqdm import tqdm

from splatpilot.analysis.reconstruction.figures import (
    Panel,
    Scale,
    colorize,
    depth_scale,
    error_scale,
    write_sheet,
)
from splatpilot.diagrams.worlds.scene_metadata import SceneMetadata, read_scene_metadata
from splatpilot.systems.configuration import load_config
from splatpilot.systems.files import written_atomically
from splatpilot.systems.splats.baked_scene import RenderedView
from splatpilot.systems.splats.gaussian_ply import read_ply
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.read_capture import read_capture
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.measures import (
    SceneRenderer,
    ViewMeasures,
    fit_exposure,
    has_true_depth,
    mean_measure,
    measure_view,
)
from splatpilot.training.reconstruction.views import shrink, shrink_factor

METRICS = "metrics.json"
SHEET = "views.png"
_EVERY = 8
_SHEET_ROWS = 4
_ERROR_LIMIT = 0.05  # brightest colour of depth errors, as a fraction of the median depth

NAMES = {
    "psnr_db": ("PSNR [dB]", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS-squeeze", "{:.3f}"),
    "depth_mae_m": ("depth MAE [m]", "{:.3f}"),
    "depth_relative": ("depth error, relative", "{:.2%}"),
    "floater_fraction": ("floaters", "{:.2%}"),
}
"""How measures are called and written in tables."""


@dataclass(frozen=True)
class SceneMeasures:
    """A scene against the frames of its capture."""

    held_out: bool
    """Whether the frames had no part in making the scene."""
    width: int  # [px], at which it was measured: images are shrunk as they were for the making
    height: int
    frames: dict[int, ViewMeasures]
    lpips_missing: str
    """Why there is no LPIPS; empty if there is."""

    def mean(self, name: str) -> float | None:
        """Returns the mean of a measure over the frames that have it; None if none has."""
        return mean_measure(self.frames.values(), name)

    def as_json(self) -> dict:
        """Returns the content of `metrics.json`: means, and the measures of each frame."""
        return {
            **{name: self.mean(name) for name in NAMES},
            "held_out": self.held_out,
            "width": self.width,
            "height": self.height,
            "lpips_missing": self.lpips_missing,
            "frames": {str(i): asdict(frame) for i, frame in self.frames.items()},
        }

    def __str__(self) -> str:
        kind = "held-out frames" if self.held_out else "frames the scene was made from"
        lines = [f"{'measured on':<22} {len(self.frames)} {kind}, {self.width} x {self.height}"]
        for name, (title, form) in NAMES.items():
            lines.append(f"{title:<22} {format_measure(self.mean(name), form)}")
        if self.lpips_missing:
            lines.append(f"no LPIPS: {self.lpips_missing}")
        return "\n".join(lines)


def format_measure(value: float | None, form: str) -> str:
    """Returns a figure as text, a dash for None."""
    return "-" if value is None else form.format(value)


def read_measures(scene: Path) -> SceneMeasures | None:
    """Returns what `metrics.json` of the scene folder says; None if there is none.

    Raises:
        ValueError: if the file is damaged.
    """
    file = scene / METRICS
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text())
        said = {field.name: content[field.name] for field in fields(SceneMeasures)}
        said["frames"] = {int(i): ViewMeasures(**frame) for i, frame in said["frames"].items()}
        return SceneMeasures(**said)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: {error!r}; delete the file and measure again") from error


def load_lpips() -> tuple[Lpips | None, str]:
    """Returns the network, or None and why there is none."""
    try:
        return Lpips(), ""
    except (OSError, ValueError) as error:
        return None, str(error)


def read_capture_of(scene: Path, metadata: SceneMetadata) -> Capture:
    """Opens the capture that a scene folder was made from, with the settings it was made with.

    Raises:
        FileNotFoundError, ValueError, OSError: if `metadata` names none, or it cannot be opened.
    """
    file = scene / "scene.yaml"
    if not metadata.capture:
        raise ValueError(
            f"{file}: names no capture to compare the scene with; reconstruct it again"
        )
    try:
        config = load_config(CaptureConfig(), overrides=metadata.capture_settings)
    except ValueError as error:
        raise ValueError(f"{file}: capture_settings: {error}") from None
    return read_capture(metadata.capture, config)


class SceneViews:
    """A scene folder beside its capture: frames as they were, and as the scene shows them.

    Args:
        scene: the scene folder.
        capture: what it was made from; read from where `scene.yaml` says if None.

    Raises:
        FileNotFoundError, ValueError: for a damaged scene, or one whose capture is not found.
    """

    def __init__(self, scene: Path, capture: Capture | None = None):
        self.metadata: SceneMetadata = read_scene_metadata(scene)
        if capture is None:
            capture = read_capture_of(scene, self.metadata)
        self.capture = capture
        lost = [i for i in self.metadata.held_out if i >= len(capture)]
        if lost:
            raise ValueError(
                f"{scene / 'scene.yaml'}: frame {lost[0]} is held out, but {capture.source} has "
                f"only {len(capture)} frames; the capture has changed, reconstruct the scene again"
            )
        self.factor = shrink_factor(capture.width, self.metadata.image_width)
        self.renderer = SceneRenderer(
            read_ply(scene / "gaussians.ply"), self.metadata.representation
        )

    def frame(self, i: int) -> CaptureFrame:
        """Returns frame i of the capture in the size at which the scene was made."""
        return self.shrink(self.capture.frame(i))

    def shrink(self, frame: CaptureFrame) -> CaptureFrame:
        """Returns a frame of the capture's camera in the size at which the scene was made."""
        return shrink(frame, self.factor)

    @property
    def fitted_poses(self) -> list[RigidTransform]:
        """The poses of the cameras that the scene was made from."""
        held_out = set(self.metadata.held_out)
        return [X_WC for i, X_WC in enumerate(self.capture.X_WCs) if i not in held_out]

    def render(self, frame: CaptureFrame) -> RenderedView:
        """Returns what the scene shows the camera of `frame`."""
        height, width = frame.depth.shape
        background = self.metadata.background
        return self.renderer.render(frame.K, width, height, frame.X_WC, background)

    def measure(self, frame: CaptureFrame, lpips: Lpips | None = None) -> ViewMeasures:
        """Compares both."""
        return measure_view(
            self.render(frame), frame.image, frame.depth, self.metadata.vignetting, lpips
        )


def measure_scene(scene: Path, capture: Capture | None = None) -> SceneMeasures:
    """Measures a scene folder and leaves `metrics.json` and the sheet `views.png` in it.

    It is measured on the held-out frames; if none was held out, on every eighth frame, which says
    less: those had a part in making it.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged scene or capture, or a folder that
            cannot be written.
    """
    views = SceneViews(scene, capture)
    lpips, missing = load_lpips()
    numbers = views.metadata.held_out or range(0, len(views.capture), _EVERY)
    frames, size = {}, (0, 0)
    for i in tqdm(numbers, "measuring", unit="frame"):
        frame = views.frame(i)
        size = frame.depth.shape
        frames[i] = views.measure(frame, lpips)
    height, width = size
    measures = SceneMeasures(bool(views.metadata.held_out), width, height, frames, missing)
    with written_atomically(scene / METRICS) as partial:
        partial.write_text(json.dumps(measures.as_json(), indent=2))
    _write_views(scene / SHEET, views, measures)
    return measures


def run(scene: Path) -> SceneMeasures:
    """Measures a scene folder, see `measure_scene`, and prints what it is and the table."""
    metadata = read_scene_metadata(scene)
    measures = measure_scene(scene)
    if metadata.provenance:
        print(f"{'made from':<22} {metadata.provenance}")
    print(f"{'seen free [m^3]':<22} {metadata.observed_free_volume:.1f}")
    if metadata.gains:
        low, high = min(metadata.gains), max(metadata.gains)
        print(f"{'image gains':<22} {low:.3f} to {high:.3f}")
    print(measures)
    return measures


def _write_views(path: Path, views: SceneViews, measures: SceneMeasures) -> None:
    """Draws some of the frames: truth and scene, in colour and depth."""
    numbers = list(measures.frames)
    picked = sorted({numbers[k] for k in np.linspace(0, len(numbers) - 1, _SHEET_ROWS).astype(int)})
    frames = [views.frame(i) for i in picked]
    depths = depth_scale([frame.depth for frame in frames])
    middle = np.median([np.median(frame.depth) for frame in frames])
    errors = error_scale(_ERROR_LIMIT * float(middle) if 0 < middle < np.inf else 0.1)
    rows = []
    for i, frame in zip(picked, frames, strict=True):
        found, view = measures.frames[i], views.render(frame)
        image, _ = fit_exposure(view.color, frame.image / 255, views.metadata.vignetting)
        row = [Panel(frame.image / 255), Panel(image, f"{found.psnr_db:.1f} dB")]
        rows.append(row + depth_panels(frame, view, found.depth_mae_m, depths, errors))
    columns = ["captured", "scene", "captured depth", "depth of the scene", "depth error"]
    scales = [depths] + [errors] * (len(rows) - 1)
    write_sheet(path, rows, columns, [f"frame {i}" for i in picked], scales)


def depth_panels(
    frame: CaptureFrame,
    view: RenderedView,
    depth_mae_m: float | None,
    depths: Scale,
    errors: Scale,
) -> list[Panel]:
    """Returns the panels of true depth, rendered depth and the difference."""
    known = has_true_depth(frame.depth)
    error: NDArray = np.abs(view.depth - np.where(known, frame.depth, 0))
    return [
        Panel(colorize(frame.depth, depths, known)),
        Panel(colorize(view.depth, depths, view.alpha > 0)),
        Panel(
            colorize(error, errors, known),
            "" if depth_mae_m is None else f"{100 * depth_mae_m:.1f} cm",
        ),
    ]
