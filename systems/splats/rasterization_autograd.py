"""The CPU rasteriser as two autograd functions with the image-plane means between them.

`Project` takes the scene to `means2d`, and has the native renderer draw the whole image on the way;
`Composite` takes `means2d` to that image. So the screen-space gradients that densification needs
are the gradient of an ordinary intermediate tensor.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native

SPLAT_GRADIENT = (
    16  # floats a splat: mean 2, |mean| 2, ln opacity, shape 3, colour 3, depth; 4 idle
)


@dataclass
class Views:
    """C cameras, how to render them, and what remains of having done so."""

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
    expected_depth: bool
    absgrad: bool
    rendered: tuple[Tensor, Tensor] | None = None  # image and alpha, from Project to Composite
    projected: list[tuple] = field(default_factory=list)  # of each camera, see Renderer.projected
    frames: list[Any] = field(default_factory=list)
    splat_gradients: Tensor | None = None  # (M, 16), from Composite to Project

    def render(
        self, gaussians: dict[str, NDArray[np.float32]], keep: bool
    ) -> tuple[Tensor, Tensor]:
        """Image (C, H, W, channels) and alpha (C, H, W, 1).

        `keep` holds on to what the backward pass needs.
        """
        image = torch.empty((len(self.poses), self.height, self.width, self.channels))
        alpha = torch.empty((len(self.poses), self.height, self.width, 1))
        for c in range(len(self.poses)):
            self.renderer.render(
                *self.scene_arguments(gaussians, c),
                self.intrinsics[c],
                self.poses[c],
                self.width,
                self.height,
                self.near_plane,
                self.far_plane,
                self.radius_clip,
                self.eps2d,
                self.antialiased,
                self.expected_depth,
                self.backgrounds[c],
                image[c].numpy(),
                alpha[c].numpy(),
                keep,
            )
            given = None if self.antialiased else gaussians["opacities"]
            self.projected.append(self.renderer.projected(given))
            if keep:
                self.frames.append(_native.kept_frame(self.renderer))
        return image, alpha

    def scene_arguments(self, gaussians: dict[str, NDArray[np.float32]], camera: int) -> tuple:
        geometry = tuple(gaussians[n] for n in ("means", "quats", "scales", "opacities"))
        degree = -1 if self.sh_degree is None else self.sh_degree
        return *geometry, self.color_rows(gaussians["colors"], camera), degree

    def color_rows(self, colors: NDArray[np.float32], camera: int) -> NDArray[np.float32]:
        """(N, K, 3) colours or coefficients of one camera; a view."""
        rows = colors[camera] if self.per_camera_colors else colors
        return rows if self.sh_degree is not None else rows[:, None, :]

    def means2d(self) -> Tensor:
        """(M, 2) [px] of the visible pairs."""
        return joined([of_camera[2] for of_camera in self.projected])

    def splats_of(self) -> list[slice]:
        """Which rows of the M visible pairs belong to each camera."""
        ends = np.cumsum([0] + [frame.splat_count for frame in self.frames])
        return [slice(*pair) for pair in pairwise(ends)]


def to_numpy(tensor: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().numpy())


def joined(parts: Sequence[NDArray]) -> Tensor:
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts))


class Project(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> means2d (M, 2) [px]."""

    @staticmethod
    def forward(ctx, views: Views, *inputs: Tensor) -> Tensor:
        ctx.views = views
        ctx.save_for_backward(*inputs)
        views.rendered = views.render(_scene(inputs), keep=True)
        return views.means2d()

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        inputs = ctx.saved_tensors
        *scene_gradients, v_viewmats = [
            torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs
        ]
        v_viewmats.zero_()
        scene, gradients = _scene(inputs), _scene(scene_gradients)
        v_means2d = v_means2d.contiguous()
        v_splats, views.splat_gradients = views.splat_gradients, None
        if v_splats is None:
            v_splats = torch.zeros(len(v_means2d), SPLAT_GRADIENT)
        for c, rows in enumerate(views.splats_of()):
            sums = _native.project_backward(
                views.renderer,
                views.frames[c],
                *views.scene_arguments(scene, c),
                v_splats[rows].numpy(),
                v_means2d[rows].numpy(),
                *views.scene_arguments(gradients, c)[:5],
                c == 0,
                c == 0 or views.per_camera_colors,
            )
            v_viewmats[c, :3] = torch.from_numpy(_pose_gradient(np.array(sums), views.poses[c]))
        return None, *scene_gradients, v_viewmats


class Composite(torch.autograd.Function):
    """(means2d, backgrounds or None) -> image (C, H, W, X), alpha (C, H, W, 1)."""

    @staticmethod
    def forward(ctx, views: Views, means2d: Tensor, backgrounds: Tensor | None):
        ctx.views = views
        # Not to stay in `views`: an output that its own node refers to is never freed.
        assert views.rendered is not None
        image, alpha = views.rendered
        views.rendered = None
        ctx.save_for_backward(means2d, image, alpha)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image: Tensor, v_alpha: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        means2d, image, alpha = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        v_means2d = v_backgrounds = None
        if ctx.needs_input_grad[1]:
            v_splats = torch.empty(len(means2d), SPLAT_GRADIENT)
            v_means2d = torch.empty(len(means2d), 2)
            for c, rows in enumerate(views.splats_of()):
                _native.raster_backward(
                    views.renderer,
                    views.frames[c],
                    v_image[c].numpy(),
                    v_alpha[c].numpy(),
                    image[c].numpy(),
                    alpha[c].numpy(),
                    views.backgrounds[c],
                    views.expected_depth,
                    views.absgrad,
                    v_splats[rows].numpy(),
                    v_means2d[rows].numpy(),
                )
            views.splat_gradients = v_splats
            if views.absgrad:
                means2d.absgrad = v_splats[:, 2:4].clone()
        if ctx.needs_input_grad[2] and views.channels > 1:
            v_backgrounds = (v_image[..., :3] * (1 - alpha)).sum((1, 2))
        return None, v_means2d, v_backgrounds


def _scene(tensors) -> dict[str, NDArray[np.float32]]:
    names = ("means", "quats", "scales", "opacities", "colors")
    return {name: to_numpy(tensor) for name, tensor in zip(names, tensors, strict=False)}


def _pose_gradient(sums: NDArray[np.float64], X_CW: NDArray[np.float64]) -> NDArray[np.float64]:
    """dL/d[R | t] (3, 4) from dL/dR with the centre held, dL/dp_C and dL/d(p_W - centre).

    p_C = R p_W + t, with p_W = d + centre; spherical harmonics look from centre = -R^-1 t.
    """
    v_R, v_p, v_direction = sums[:9].reshape(3, 3), sums[9:12], sums[12:]
    R, t = X_CW[:3, :3], X_CW[:3, 3]
    v_t = v_p + np.linalg.solve(R.T, v_direction)
    return np.column_stack([v_R - np.outer(v_t, np.linalg.solve(R, t)), v_t])
