"""The CPU rasteriser as two autograd functions with the image-plane means between them.

The native renderer draws the whole image at once. `Project` then takes the scene to `means2d`, and
`Composite` takes `means2d` to the image. So the screen-space gradients that densification needs
are the gradient of an ordinary intermediate tensor.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.splats.rasterization_views import (
    Drawing,
    Views,
    gradient_arguments,
    rows_of_cameras,
    scene_arguments,
    scene_arrays,
)

SPLAT_GRADIENT = (
    16  # floats a splat: mean 2, |mean| 2, ln opacity, shape 3, colour 3, depth; 4 idle
)


def splat_outputs(drawing: Drawing) -> tuple[Tensor, Tensor]:
    """`means2d` (M, 2), and what stands for the rest of the splats.

    The latter, (M, 16), has no values that mean anything: it is there for its gradient.
    """
    means2d = drawing.means2d()
    return means2d, torch.full((1, 1), torch.nan).expand(len(means2d), SPLAT_GRADIENT)


def splat_gradients(
    count: int, v_means2d: Tensor | None, v_splats: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The gradients of the `splat_outputs` of M = `count` pairs, zeros where None."""
    if v_means2d is None:
        v_means2d = torch.zeros(count, 2)
    if v_splats is None:
        v_splats = torch.zeros(count, SPLAT_GRADIENT)
    return v_means2d.contiguous(), v_splats.contiguous()


class Project(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> see `splat_outputs`."""

    @staticmethod
    def forward(ctx, views: Views, drawing: Drawing, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        ctx.views, ctx.frames = views, drawing.frames
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        return splat_outputs(drawing)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d: Tensor | None, v_splats: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        inputs = ctx.saved_tensors
        *scene_gradients, v_viewmats = [
            torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs
        ]
        v_viewmats.zero_()
        scene, gradients = scene_arrays(inputs), scene_arrays(scene_gradients)
        rows_of = rows_of_cameras(ctx.frames)
        v_means2d, v_splats = splat_gradients(rows_of[-1].stop, v_means2d, v_splats)
        for c, rows in enumerate(rows_of):
            by_camera = _native.project_backward(
                views.renderer,
                ctx.frames[c],
                **scene_arguments(scene, views.sh_degree, c),
                v_splats=v_splats[rows].numpy(),
                v_means2d=v_means2d[rows].numpy(),
                **gradient_arguments(gradients, views.sh_degree, c),
                overwrite=c == 0,
                overwrite_colors=c == 0 or views.per_camera_colors,
            )
            if ctx.needs_input_grad[-1]:
                v_viewmats[c, :3] = torch.from_numpy(_pose_gradient(by_camera, views.poses[c]))
        return None, None, *scene_gradients, v_viewmats


class Composite(torch.autograd.Function):
    """(means2d, splats, backgrounds or None) -> image (C, H, W, X), alpha (C, H, W, 1).

    means2d and splats are those of `splat_outputs`.
    """

    @staticmethod
    def forward(
        ctx,
        views: Views,
        drawing: Drawing,
        means2d: Tensor,
        splats: Tensor,
        backgrounds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        # The frames alone: an output that its own node refers to is never freed.
        ctx.views, ctx.frames = views, drawing.frames
        ctx.save_for_backward(means2d, drawing.image, drawing.alpha)
        return drawing.image, drawing.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image: Tensor, v_alpha: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        views: Views = ctx.views
        means2d, image, alpha = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        if views.depth_mode == _native.DepthMode.MEDIAN:
            v_image = v_image.clone()
            v_image[..., -1] = 0
        v_means2d = v_splats = v_backgrounds = None
        if ctx.needs_input_grad[2]:
            v_splats = torch.empty(len(means2d), SPLAT_GRADIENT)
            v_means2d = torch.empty(len(means2d), 2)
            for c, rows in enumerate(rows_of_cameras(ctx.frames)):
                _native.raster_backward(
                    views.renderer,
                    ctx.frames[c],
                    v_image=v_image[c].numpy(),
                    v_alpha=v_alpha[c].numpy(),
                    image=image[c].numpy(),
                    alpha=alpha[c].numpy(),
                    background=views.backgrounds[c],
                    expected_depth=views.depth_mode == _native.DepthMode.EXPECTED,
                    absolute=views.absgrad,
                    v_splats=v_splats[rows].numpy(),
                    v_means2d=v_means2d[rows].numpy(),
                )
            if views.absgrad:
                means2d.absgrad = v_splats[:, 2:4].clone()
        if ctx.needs_input_grad[4] and views.channels > 1:
            v_backgrounds = (v_image[..., :3] * (1 - alpha)).sum((1, 2))
        return None, None, v_means2d, v_splats, v_backgrounds


def _pose_gradient(sums: NDArray[np.float64], X_CW: NDArray[np.float64]) -> NDArray[np.float64]:
    """dL/d[R | t] (3, 4) from dL/dR with the centre held, dL/dp_C and dL/d(p_W - centre).

    p_C = R p_W + t, with p_W = d + centre; spherical harmonics look from centre = -R^-1 t.
    """
    v_R = sums[:3]
    v_p: NDArray[np.float64] = sums[3]
    v_direction: NDArray[np.float64] = sums[4]
    R, t = X_CW[:3, :3], X_CW[:3, 3]
    v_t = v_p + np.linalg.solve(R.T, v_direction)
    return np.column_stack([v_R - np.outer(v_t, np.linalg.solve(R, t)), v_t])
