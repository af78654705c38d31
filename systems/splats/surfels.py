"""2D Gaussian splatting (surfels; Huang et al. 2024): native on the CPU, gsplat on CUDA."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats.baked_scene import check_camera, create_renderer
from splatpilot.systems.splats.depth_normals import depth_to_normals
from splatpilot.systems.splats.gsplat_kernels import rasterize_surfels_by_gsplat
from splatpilot.systems.splats.rasterization_checks import (
    by_name,
    check_device,
    check_render_mode,
    check_shapes,
    check_values,
    pair_meta,
)
from splatpilot.systems.splats.rasterization_views import joined
from splatpilot.systems.splats.surfels_autograd import (
    RasterizeSurfels,
    SurfelView,
    draw_surfels,
)

DEPTH_MODES = ("expected", "median")
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterize_surfels(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    sh_degree: int | None = None,
    *,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    distloss: bool = False,
    depth_mode: str = "expected",
    renderer: _native.Renderer | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """Renders N surfels into C pinhole cameras, with the interface of gsplat.rasterization_2dgs.

    A surfel is a Gaussian on the plane through its mean spanned by the first two columns of its
    rotation. The ray through a pixel meets that plane at (u, v) standard deviations and depth z;
    then ``a = min(.99, o exp(-r2 / 2))``, with r2 the lesser of u^2 + v^2 and 2 |d|^2, d the
    pixels to the projected mean: a blob of sqrt(1/2) px stands in for surfels smaller than a pixel
    or seen edge-on, at the depth of the mean. Blending is that of `rasterize`, in the order of the
    means' depths.

    Depths are those at which rays meet the surfels, as in the paper, so that a plane of surfels
    has the plane's depth; gsplat blends the depths of the means. Rays that meet a surfel nearer
    than `near_plane` miss it.

    float32 CPU tensors go to the native kernels, CUDA tensors to gsplat's own, whose differences
    are those named above.

    Differentiable with respect to means, quats, scales (the first two), opacities, colors,
    viewmats and backgrounds. Which surfels a pixel sees, and which gives its median, is constant.

    Args:
        means, quats, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane,
            radius_clip, sh_degree, backgrounds, render_mode, renderer: as for `rasterize`.
        scales: (N, 3) standard deviations [m], positive; the third does not matter.
        distloss: Whether to render the distortion; needs a `render_mode` with depth, as gsplat.
        depth_mode: Of which depth surface normals are: "expected" or "median".

    Returns:
        render_colors: (C, H, W, X), X = 3, 1 or 4 by `render_mode`.
        render_alphas: (C, H, W, 1).
        render_normals: (C, H, W, 3) sum of weight and normal, in the world, towards the camera.
        surf_normals: (C, H, W, 3) from depth, see `depth_to_normals`; None for "RGB".
        render_distort: (C, H, W, 1) sum over pairs of surfels i, j of ``w_i w_j (z_i - z_j)``, i
            behind j in the order of blending, times 2 [m]; zero without `distloss`.
        render_median: (C, H, W, 1) depth of the last surfel in front of which more than half of
            the light passes [m]; 0 where there is none.
        meta: dict on the M visible (camera, surfel) pairs: camera_ids, gaussian_ids, depths,
            opacities (M,), radii, means2d (M, 2), normals (M, 3) in the world, and width, height,
            tile_size, tile_width, tile_height, n_cameras, render_distort.

    Raises:
        ValueError: a tensor has the wrong shape, dtype, device or values (the message names it).
        ModuleNotFoundError: tensors are on a GPU and gsplat is not installed.
    """
    scene = (means, quats, scales, opacities, colors, viewmats)
    tensors = by_name(*scene, Ks, backgrounds)
    _check_options(render_mode, depth_mode, distloss, radius_clip)
    check_shapes(tensors, sh_degree)
    if means.device.type == "cuda":
        return rasterize_surfels_by_gsplat(
            scene,
            Ks,
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            radius_clip=radius_clip,
            sh_degree=sh_degree,
            backgrounds=backgrounds,
            render_mode=render_mode,
            distloss=distloss,
            depth_mode=depth_mode,
        )
    check_device(means)
    if Ks.requires_grad:
        raise ValueError("Ks requires a gradient, which is not available; use Ks.detach()")
    view = SurfelView(
        renderer=create_renderer() if renderer is None else renderer,
        intrinsics=[
            check_camera(K, width, height, near_plane, far_plane) for K in Ks.detach().numpy()
        ],
        poses=viewmats.detach().double().numpy(),
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        sh_degree=sh_degree,
        distort=distloss,
    )
    arrays = {k: np.ascontiguousarray(t.detach().numpy()) for k, t in tensors.items()}
    # The third scale is not read; whatever it is, it is no error.
    check_values(arrays, view.renderer, scale_axes=2)
    wants_gradients = torch.is_grad_enabled() and any(t.requires_grad for t in tensors.values())
    drawing = draw_surfels(view, arrays, keep=wants_gradients)
    images = drawing.images
    if wants_gradients:
        images = RasterizeSurfels.apply(view, drawing, *scene)
    color, normal, depth, alpha, median, distort = images

    parts, surface = [], None
    if "RGB" in render_mode:
        if backgrounds is not None:
            color = color + (1 - alpha) * backgrounds[:, None, None, :]
        parts.append(color)
    if "D" in render_mode:
        expected = depth / alpha.clamp(min=1e-10)
        parts.append(expected if "ED" in render_mode else depth)
        surface = depth_to_normals(expected if depth_mode == "expected" else median, viewmats, Ks)
    image = parts[0] if len(parts) == 1 else torch.cat(parts, -1)
    meta = _meta(drawing.projected, arrays["opacities"], width, height)
    meta["render_distort"] = distort
    return image, alpha, normal, surface, distort, median, meta


def _check_options(render_mode: str, depth_mode: str, distloss: bool, radius_clip: float) -> None:
    check_render_mode(render_mode, RENDER_MODES)
    if depth_mode not in DEPTH_MODES:
        raise ValueError(f"depth_mode is {depth_mode!r}; it must be one of {DEPTH_MODES}")
    if distloss and "D" not in render_mode:
        raise ValueError(
            f"distloss needs depth, but render_mode is {render_mode!r}; use 'RGB+D' or 'RGB+ED'"
        )
    if not 0 <= radius_clip < float("inf"):
        raise ValueError(f"radius_clip is {radius_clip}; it must be a finite number of pixels >= 0")


def _meta(projected: list[tuple], opacities: np.ndarray, width: int, height: int) -> dict[str, Any]:
    ids, radii, means2d, depths, normals = (joined(parts) for parts in zip(*projected, strict=True))
    return pair_meta([len(p[0]) for p in projected], width, height) | {
        "gaussian_ids": ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "normals": normals,
        "opacities": torch.from_numpy(opacities)[ids],
    }
