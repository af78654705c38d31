"""Surfels on the CPU as a node of torch's graph: C cameras drawn natively, and their gradients."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats.rasterization_views import (
    gradient_arguments,
    scene_arguments,
    scene_arrays,
)

IMAGES = {"color": 3, "normal": 3, "depth": 1, "alpha": 1, "median": 1, "distort": 1}  # channels


class SurfelView(NamedTuple):
    """C cameras and how to render them."""

    renderer: _native.Renderer
    intrinsics: list[np.ndarray]  # C x (3, 3) float64 [px]
    poses: np.ndarray  # (C, 4, 4) X_CW, float64
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    sh_degree: int | None
    distort: bool


class SurfelDrawing(NamedTuple):
    """Images of C cameras, and what remains of them."""

    images: tuple[Tensor, ...]  # (C, H, W, channels) in the order of IMAGES
    frames: list[_native.SurfelFrame]
    projected: list[tuple]  # of each camera, see `_native.projected_surfels`


def draw_surfels(view: SurfelView, arrays: dict[str, np.ndarray], keep: bool) -> SurfelDrawing:
    """Renders; with `keep`, a backward pass can start from the frames."""
    size = (len(view.poses), view.height, view.width)
    images = {name: torch.empty((*size, channels)) for name, channels in IMAGES.items()}
    if not view.distort:
        images["distort"].zero_()
    drawing = SurfelDrawing(tuple(images.values()), [], [])
    for c in range(len(view.poses)):
        outputs: dict[str, Any] = {name: image[c].numpy() for name, image in images.items()}
        if not view.distort:
            outputs["distort"] = None
        frame = _native.render_surfels(
            view.renderer,
            **scene_arguments(arrays, view.sh_degree, c),
            K=view.intrinsics[c],
            X_CW=view.poses[c],
            width=view.width,
            height=view.height,
            near_plane=view.near_plane,
            far_plane=view.far_plane,
            radius_clip=view.radius_clip,
            **outputs,
            keep=keep,
        )
        drawing.frames.append(frame)
        drawing.projected.append(_native.projected_surfels(view.renderer, frame))
    return drawing


class RasterizeSurfels(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> images in the order of IMAGES."""

    @staticmethod
    def forward(
        ctx, view: SurfelView, drawing: SurfelDrawing, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        # The frames alone: an output that its own node refers to is never freed.
        ctx.view, ctx.frames = view, drawing.frames
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        if not view.distort:
            ctx.mark_non_differentiable(drawing.images[-1])
        return drawing.images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *v_images: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        view: SurfelView = ctx.view
        inputs = ctx.saved_tensors
        v_inputs = [torch.zeros_like(t, memory_format=torch.contiguous_format) for t in inputs]
        arrays, gradients = scene_arrays(inputs), scene_arrays(v_inputs)
        if not view.distort:
            v_images = (*v_images[:-1], None)
        given = [None if v is None else v.contiguous() for v in v_images]
        for c, X_CW in enumerate(view.poses):
            of_camera: dict[str, Any] = {
                f"v_{name}": None if v is None else v[c].numpy()
                for name, v in zip(IMAGES, given, strict=True)
            }
            by_camera = _native.surfels_backward(
                view.renderer,
                ctx.frames[c],
                **scene_arguments(arrays, view.sh_degree, c),
                **of_camera,
                **gradient_arguments(gradients, view.sh_degree, c),
            )
            v_inputs[5][c] = torch.from_numpy(_viewmat_gradient(by_camera, X_CW))
        return None, None, *v_inputs


def _viewmat_gradient(by_camera: np.ndarray, X_CW: np.ndarray) -> np.ndarray:
    """Adds to the gradient of R and t that of the camera centre, -R^-1 t."""
    gradient = np.zeros((4, 4))
    R_inverse = np.linalg.inv(X_CW[:3, :3])
    through_centre = -R_inverse.T @ by_camera[4]
    gradient[:3, :3] = by_camera[:3] + np.outer(through_centre, -R_inverse @ X_CW[:3, 3])
    gradient[:3, 3] = by_camera[3] + through_centre
    return gradient
