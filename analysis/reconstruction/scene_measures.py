"""The figures of a scene against the frames of its capture: `metrics.json`."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight.flight_diagram import MakeCamera
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import (
    FRONTIER,
    SceneMetadata,
    read_background,
    read_scene_folder,
    read_scene_metadata,
)
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.splats.background import put_behind
from splatpilot.systems.splats.baked_scene import RenderedView
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.training.captures.capture import Capture, CaptureFrame, shrink, shrink_factor
from splatpilot.training.captures.capture_registry import read_capture_of
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.metrics import (
    SceneRenderer,
    ViewMetrics,
    mean_metric,
    measure_view,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, seen_pixels

METRICS = "metrics.json"
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
"""How measures are called and written in tables."""
_MOSTLY_UNSEEN = 0.5
"""Share of the pixels of the default flight from which on a warning is given."""


@dataclass(frozen=True)
class SceneMetrics:
    """A scene against the frames of its capture."""

    held_out: bool
    """Whether the frames had no part in making the scene."""
    width: int  # [px], at which it was measured: images are shrunk as they were for the making
    height: int
    frames: dict[int, ViewMetrics]
    """In the pixels that show what the scene was made from, exposed to fit."""
    strict_frames: dict[int, ViewMetrics]
    """In all pixels, with a gain of 1."""
    lpips_missing: str
    """Why there is no LPIPS; empty if there is."""
    flight_unseen_fraction: float | None
    """See `unseen_share`; None of a scene that cannot be flown in."""

    def mean(self, name: str) -> float | None:
        """Returns the mean of a measure over the frames that have it; None if none has."""
        return mean_metric(self.frames.values(), name)[0]

    def strict_mean(self, name: str) -> float | None:
        """Returns the same in all pixels, with a gain of 1."""
        return mean_metric(self.strict_frames.values(), name)[0]

    @property
    def worst_hole_fraction(self) -> float | None:
        """The share of holes in the frame that has most; None if none has true depth."""
        found = (frame.hole_fraction for frame in self.frames.values())
        return max((share for share in found if share is not None), default=None)

    def as_json(self) -> dict:
        """Returns the content of `metrics.json`: means, over how many frames, and the measures of
        each frame."""
        return {
            **{name: self.mean(name) for name in NAMES},
            "counts": {name: mean_metric(self.frames.values(), name)[1] for name in NAMES},
            "strict": {name: self.strict_mean(name) for name in NAMES},
            "worst_hole_fraction": self.worst_hole_fraction,
            "held_out": self.held_out,
            "width": self.width,
            "height": self.height,
            "lpips_missing": self.lpips_missing,
            "flight_unseen_fraction": self.flight_unseen_fraction,
            "frames": {str(i): asdict(frame) for i, frame in self.frames.items()},
            "strict_frames": {str(i): asdict(f) for i, f in self.strict_frames.items()},
        }

    def __str__(self) -> str:
        kind = "held-out frames" if self.held_out else "frames the scene was made from"
        lines = [
            f"{'measured on':<22} {len(self.frames)} {kind}, {self.width} x {self.height}",
            f"{'':<22} {'seen pixels, gain fitted':<26} all pixels, no gain",
        ]
        for name, (title, form) in NAMES.items():
            mean, count = mean_metric(self.frames.values(), name)
            told = format_metric(mean, form)
            if 0 < count < len(self.frames):
                told += f" ({count} of {len(self.frames)} frames)"
            strict = format_metric(self.strict_mean(name), form)
            lines.append(f"{title:<22} {told:<26} {strict}")
        worst = format_metric(self.worst_hole_fraction, NAMES["hole_fraction"][1])
        lines.append(f"{'holes, worst frame':<22} {worst}")
        unseen = self.flight_unseen_fraction
        lines.append(f"{'unseen in flight':<22} {format_metric(unseen, '{:.1%}')}")
        if unseen is not None and unseen > _MOSTLY_UNSEEN:
            lines.append(
                "warning: a flight from the default start to the default goal looks mostly into "
                "space that no camera saw; capture it looking ahead along such routes"
            )
        if self.lpips_missing:
            lines.append(f"no LPIPS: {self.lpips_missing}")
        return "\n".join(lines)


def format_metric(value: float | None, form: str) -> str:
    """Returns a figure as text, a dash for None."""
    return "-" if value is None else form.format(value)


def read_metrics(scene: Path) -> SceneMetrics | None:
    """Returns what `metrics.json` of the scene folder says; None if there is none.

    Raises:
        ValueError: if the file is damaged.
    """
    file = scene / METRICS
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text())
        said = {field.name: content[field.name] for field in fields(SceneMetrics)}
        for name in ("frames", "strict_frames"):
            said[name] = {int(i): ViewMetrics(**frame) for i, frame in said[name].items()}
        return SceneMetrics(**said)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: {error!r}; delete the file and measure again") from error


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
        self.background = read_background(scene, self.metadata)
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

    @property
    def measured(self) -> Sequence[int]:
        """The frames on which the scene is measured: those held out, or every eighth."""
        return self.metadata.held_out or range(0, len(self.capture), 8)

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
        return put_behind(self._render_on_black(frame), self.background, frame.K, frame.X_WC)

    @cached_property
    def _fitted(self) -> list[ThinnedFrame]:
        """The frames that the scene was made from."""
        held_out = set(self.metadata.held_out)
        numbers = [i for i in range(len(self.capture)) if i not in held_out]
        return [ThinnedFrame.of(self.frame(i)) for i in numbers]

    def seen(self, frame: CaptureFrame) -> NDArray[np.bool_]:
        """Returns the pixels (H, W) of `frame` that show what the scene was made from."""
        return seen_pixels(frame, self._fitted)

    def measure(
        self,
        frame: CaptureFrame,
        seen: NDArray[np.bool_] | None = None,
        lpips: Lpips | None = None,
        *,
        fit_gain: bool = True,
    ) -> ViewMetrics:
        """Compares both, in the pixels `seen` or in all, see `measure_view`."""
        on_black, vignetting = self._render_on_black(frame), self.metadata.vignetting
        return measure_view(
            on_black, self.background, frame, vignetting, seen, lpips, fit_gain=fit_gain
        )

    def _render_on_black(self, frame: CaptureFrame) -> RenderedView:
        height, width = frame.depth.shape
        return self.renderer.render(frame.K, width, height, frame.X_WC)


_POSES = 36


def unseen_share(scene: Path) -> float | None:
    """Returns the mean share of the onboard camera's pixels that show the frontier, along the route
    from the start to the goal of a scene folder, looking ahead; None if there is no route.

    Raises:
        FileNotFoundError, ValueError: for a damaged scene.
    """
    metadata = read_scene_metadata(scene)
    if not metadata.metric:
        return None
    world = read_scene_folder(scene)
    try:
        toa = time_of_arrival(world.esdf.conservative(), world.p_WG)
    except InfeasibleFlightError:
        return None
    if not toa.is_reachable(world.p_WS):
        return None
    if not metadata.frontier:
        return 0.0
    frontier = _painted(read_ply(scene / FRONTIER), 1.0)
    seen = _painted(read_ply(scene / "gaussians.ply"), 0.0).merged_with(frontier)
    camera = MakeCamera(Scenario(), replace(world, gaussians=seen, background=(0.0, 0.0, 0.0)))
    # Every point beyond the goal is the goal: the poses are those before it.
    reach = float(toa.value(world.p_WS))  # [m] at 1 m/s in the open, and no less than the length
    points, directions = toa.path(world.p_WS, np.linspace(0.0, reach, 8 * _POSES))
    before = np.flatnonzero(np.linalg.norm(directions[:, :2], axis=1) > 0.0)
    chosen = before[np.linspace(0, len(before) - 1, _POSES).astype(int)]
    shares = []
    for p_WB, direction in zip(points[chosen], directions[chosen], strict=True):
        yaw = np.arctan2(direction[1], direction[0])
        view = camera.render(RigidTransform(RollPitchYaw(0.0, 0.0, yaw), p_WB))
        shares.append((view.color[..., 0] > 0.5).mean())
    return float(np.mean(shares))


def _painted(gaussians: GaussianScene, level: float) -> GaussianScene:
    """The same Gaussians in one grey, 0 to 1."""
    sh = np.full((len(gaussians), 1, 3), color_to_sh(level), dtype=np.float32)
    return replace(gaussians, sh=sh)
