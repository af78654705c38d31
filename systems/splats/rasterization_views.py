"""Cameras, what the native rasteriser draws for them, and how it takes what it draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats.rasterization_checks import SCENE


class Drawing(NamedTuple):
    """Images of C cameras with M visible (camera, Gaussian) pairs, and what remains of them."""

    image: Tensor  # (C, H, W, X)
    alpha: Tensor  # (C, H, W, 1)
    frames: list[_native.Frame]
    projected: list[tuple[NDArray[Any], ...]]  # of each camera, see `_native.projected`

    def means2d(self) -> Tensor:
        """(M, 2) [px]."""
        return joined([of_camera[2] for of_camera in self.projected])


@dataclass(frozen=True)
class Views:
    """C cameras and how to render them."""

    renderer: _native.Renderer
    intrinsics: list[NDArray[np.float64]]  # C x (3, 3) [px]
    poses: NDArray[np.float64]  # (C, 4, 4) X_CW
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    antialiased: bool
    sh_degree: int | None
    per_camera_colors: bool
    backgrounds: NDArray[np.float32]  # (C, 3)
    channels: int
    depth_mode: _native.DepthMode
    absgrad: bool

    def draw(self, gaussians: dict[str, NDArray[np.float32]], keep: bool) -> Drawing:
        """Renders; with `keep`, a backward pass can start from the frames."""
        drawing = self.blank()
        for c in range(len(self.poses)):
            frame = _native.render(
                self.renderer,
                **scene_arguments(gaussians, self.sh_degree, c),
                K=self.intrinsics[c],
                X_CW=self.poses[c],
                near_plane=self.near_plane,
                far_plane=self.far_plane,
                eps2d=self.eps2d,
                antialiased=self.antialiased,
                **self.image_arguments(drawing, c),
                keep=keep,
            )
            given = None if self.antialiased else gaussians["opacities"]
            drawing.projected.append(_native.projected(self.renderer, frame, given))
            drawing.frames.append(frame)
        return drawing

    def blank(self) -> Drawing:
        """Images that are not initialised."""
        size = (len(self.poses), self.height, self.width)
        return Drawing(torch.empty((*size, self.channels)), torch.empty((*size, 1)), [], [])

    def image_arguments(self, drawing: Drawing, camera: int) -> dict[str, Any]:
        """What every native rendering of one camera takes."""
        return {
            "width": self.width,
            "height": self.height,
            "radius_clip": self.radius_clip,
            "depth_mode": self.depth_mode,
            "background": self.backgrounds[camera],
            "image": drawing.image[camera].numpy(),
            "alpha": drawing.alpha[camera].numpy(),
        }


def scene_arguments(
    gaussians: dict[str, NDArray[np.float32]], sh_degree: int | None, camera: int
) -> dict[str, Any]:
    """What native functions take of Gaussians or surfels, for one camera."""
    colors = gaussians["colors"] if sh_degree is not None else gaussians["colors"][..., None, :]
    return {
        **{name: gaussians[name] for name in SCENE},
        "colors": colors[camera] if colors.ndim == 4 else colors,  # (N, K, 3), a view
        "sh_degree": -1 if sh_degree is None else sh_degree,
    }


def gradient_arguments(
    gradients: dict[str, NDArray[np.float32]], sh_degree: int | None, camera: int
) -> dict[str, Any]:
    """Where native functions write the gradients of `scene_arguments`."""
    arguments = scene_arguments(gradients, sh_degree, camera)
    return {f"v_{name}": arguments[name] for name in SCENE}


def rows_of_cameras(frames: Sequence[_native.Frame]) -> list[slice]:
    """Which rows of the M visible pairs belong to each camera."""
    ends = np.cumsum([0] + [frame.splat_count for frame in frames])
    return [slice(*pair) for pair in pairwise(ends)]


def to_numpy(tensor: Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().numpy())


def joined(parts: Sequence[NDArray]) -> Tensor:
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts))


def scene_arrays(tensors: Sequence[Tensor]) -> dict[str, NDArray[np.float32]]:
    """The first five, in the order of SCENE."""
    return {name: to_numpy(tensor) for name, tensor in zip(SCENE, tensors, strict=False)}
