"""A scene folder beside the capture that it was made from."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.scene_folder import read_background
from splatpilot.diagrams.worlds.scene_metadata import SceneMetadata, read_scene_metadata
from splatpilot.systems.splats.background import put_behind
from splatpilot.systems.splats.baked_scene import RenderedView
from splatpilot.systems.splats.gaussian_ply import read_ply
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.captures.capture_of_scene import read_capture_of
from splatpilot.training.captures.shrink_frame import shrink, shrink_factor
from splatpilot.training.reconstruction.lpips import Lpips
from splatpilot.training.reconstruction.measures import SceneRenderer, ViewMeasures, measure_view
from splatpilot.training.reconstruction.overlap import ThinnedFrame, seen_pixels


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
    ) -> ViewMeasures:
        """Compares both, in the pixels `seen` or in all, see `measure_view`."""
        on_black, vignetting = self._render_on_black(frame), self.metadata.vignetting
        return measure_view(
            on_black, self.background, frame, vignetting, seen, lpips, fit_gain=fit_gain
        )

    def _render_on_black(self, frame: CaptureFrame) -> RenderedView:
        height, width = frame.depth.shape
        return self.renderer.render(frame.K, width, height, frame.X_WC)
