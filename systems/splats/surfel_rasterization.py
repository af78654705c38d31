"""2D Gaussian splatting (surfels; Huang et al. 2024): native on the CPU, gsplat on CUDA."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.splats.baked_scene import check_camera, create_renderer
from splatpilot.systems.splats.rasterization import (
    by_name,
    check_device,
    check_render_mode,
    check_shapes,
    check_values,
    gradient_arguments,
    joined,
    pair_meta,
    rasterize_surfels_by_gsplat,
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


def depth_to_normals(depths: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """Unit normals of the surface that depth images show, by central differences.

    The normal at a pixel is that of the plane through the differences between its neighbours'
    points, ``(p_below - p_above) x (p_right - p_left)``, which faces the camera (Huang et al. 2024,
    equation 15). Differentiable with respect to depths and viewmats.

    Args:
        depths: (C, H, W, 1) depth along z [m].
        viewmats: (C, 4, 4) world to camera (x right, y down, z forward).
        Ks: (C, 3, 3) intrinsics [px]; pixel centres lie at +1/2.

    Returns:
        (C, H, W, 3) in the world; zero at the border and where the depth is zero all around.

    Raises:
        ValueError: the shapes do not fit.
    """
    if depths.ndim != 4 or depths.shape[-1] != 1:
        raise ValueError(f"depths has shape {tuple(depths.shape)}; it must be (C, H, W, 1)")
    C, H, W, _ = depths.shape
    for name, tensor, size in (("viewmats", viewmats, 4), ("Ks", Ks, 3)):
        if tensor.shape != (C, size, size):
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}; it must be ({C}, {size}, {size})"
            )
    # Component by component: images of vectors take torch several times as long.
    x = ((torch.arange(W) + 0.5 - Ks[:, None, 0, 2]) / Ks[:, None, 0, 0])[:, None, :]
    y = ((torch.arange(H) + 0.5 - Ks[:, None, 1, 2]) / Ks[:, None, 1, 1])[:, :, None]
    z = depths[..., 0]  # (C, H, W)
    point = (x * z, y * z, z)  # in the camera frame
    a0, a1, a2 = (c[:, 2:, 1:-1] - c[:, :-2, 1:-1] for c in point)
    b0, b1, b2 = (c[:, 1:-1, 2:] - c[:, 1:-1, :-2] for c in point)
    n = (a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0)
    squared = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    # Without a plane there is neither a normal nor a gradient, which division would make huge.
    inverse = torch.where(squared > 1e-24, torch.rsqrt(squared.clamp(min=1e-24)), 0.0)
    R = viewmats[:, :3, :3, None, None]
    normals = torch.stack(
        [(R[:, 0, i] * n[0] + R[:, 1, i] * n[1] + R[:, 2, i] * n[2]) * inverse for i in range(3)],
        -1,
    )
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))


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
