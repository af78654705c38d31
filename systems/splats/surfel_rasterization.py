"""2D Gaussian splatting (surfels; Huang et al. 2024): native on the CPU, gsplat on CUDA."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.rasterization import (
    Views,
    joined,
    named_tensors,
    over_backgrounds,
    pair_meta,
    prepare,
    require_choice,
)

IMAGES = {"color": 3, "normal": 3, "depth": 1, "alpha": 1, "median": 1, "distort": 1}  # channels
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


class RasterizeSurfels(torch.autograd.Function):
    """(means, quats, scales, opacities, colors, viewmats) -> images in the order of `IMAGES`.

    The results come in a tuple: autograd would alias tensors that are inputs.
    """

    @staticmethod
    def forward(
        ctx,
        views: Views,
        frames: list[_native.SurfelFrame],
        distort: bool,
        results: tuple[Tensor, ...],
        *inputs: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.views, ctx.frames, ctx.distort = views, frames, distort
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        if not distort:
            ctx.mark_non_differentiable(results[-1])
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx, *v_images: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        given: dict[str, Any] = {
            f"v_{name}": None if v is None else v.contiguous().numpy()
            for name, v in zip(IMAGES, v_images, strict=True)
        }
        if not ctx.distort:
            given["v_distort"] = None
        gradients = ctx.views.project_backward(
            ctx.saved_tensors,
            lambda c, *scene: _native.surfels_backward(
                ctx.views.renderer,
                ctx.frames[c],
                *scene,
                **{name: None if v is None else v[c] for name, v in given.items()},
            ),
        )
        return None, None, None, None, *gradients


def depth_to_normals(depths: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """Computes unit normals (C, H, W, 3) in the world, toward the camera, of depths (C, H, W, 1).

    By central differences (Huang et al. 2024, equation 15); zero at the border and if the depth is
    zero all around. Differentiable with respect to depths [m] and viewmats (C, 4, 4).
    """
    valid = depths.ndim == 4 and depths.shape[-1] == 1
    require(valid, "depths", "of shape (C, H, W, 1)", tuple(depths.shape))
    H, W = depths.shape[1:3]
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
    rotation. One smaller than a pixel or seen edge-on is a blob of sqrt(1/2) px at the depth of the
    mean. Blending is that of `rasterize`, in the order of the means' depths. Depths are those at
    which rays meet the surfels, not nearer than `near_plane`; gsplat blends those of the means.

    Args: as for `rasterize`; the third of the scales does not matter. Further:
        distloss: if true, renders the distortion; needs a `render_mode` with depth, as gsplat.
        depth_mode: Depth of the surface normals: "expected" or "median".

    Returns:
        render_colors: (C, H, W, X), X = 3, 1 or 4 by `render_mode`.
        render_alphas: (C, H, W, 1).
        render_normals: (C, H, W, 3) sum of weight and normal, in the world, toward the camera.
        surf_normals: (C, H, W, 3) from depth, see `depth_to_normals`; None for "RGB".
        render_distort: (C, H, W, 1) sum over pairs of surfels i, j of ``w_i w_j (z_i - z_j)``, i
            behind j in the order of blending, times 2 [m]; zero without `distloss`.
        render_median: (C, H, W, 1) depth [m] of the last surfel with a transmittance > 1/2 in front
            of it; 0 without one.
        meta: dict on the M visible (camera, surfel) pairs: camera_ids, gaussian_ids, depths,
            opacities (M,), radii, means2d (M, 2), normals (M, 3) in the world, and width, height,
            tile_size, tile_width, tile_height, n_cameras, render_distort.
    """
    scene = (means, quats, scales, opacities, colors, viewmats)
    require_choice("render_mode", render_mode, RENDER_MODES)
    require_choice("depth_mode", depth_mode, ("expected", "median"))
    with_depth = "D" in render_mode
    require(not distloss or with_depth, "render_mode", "one with depth for distloss", render_mode)
    tensors = named_tensors(*scene, Ks, backgrounds, sh_degree=sh_degree)
    optics: dict[str, Any] = {
        "width": width,
        "height": height,
        "near_plane": near_plane,
        "far_plane": far_plane,
        "radius_clip": radius_clip,
    }
    if means.device.type == "cuda":
        modes = {"render_mode": render_mode, "distloss": distloss, "depth_mode": depth_mode}
        image, alpha, *others = _rasterize_by_gsplat(
            *scene, Ks, **optics, sh_degree=sh_degree, **modes
        )
        image = over_backgrounds(backgrounds, image, alpha, render_mode)
        return image, alpha, *others  # pyright: ignore[reportReturnType]
    views, arrays = prepare(tensors, sh_degree, renderer, scale_axes=2, **optics)
    keep, shape = views.with_gradients, (len(viewmats), height, width)
    images = tuple(torch.empty((*shape, channels)) for channels in IMAGES.values())
    if not distloss:
        images[-1].zero_()
    frames, projected = [], []
    for c, camera in enumerate(views.cameras):
        outputs: dict[str, Any] = {
            name: image[c].numpy() for name, image in zip(IMAGES, images, strict=True)
        }
        if not distloss:
            outputs["distort"] = None
        surfels = views.gaussians(arrays, c)
        frame = _native.render_surfels(views.renderer, surfels, camera, **outputs, keep=keep)
        projected.append(_native.projected_surfels(views.renderer, frame))
        frames.append(frame)
    if keep:
        images = RasterizeSurfels.apply(views, frames, distloss, images, *scene)
    color, normal, depth, alpha, median, distort = images  # pyright: ignore[reportGeneralTypeIssues]

    expected = depth / alpha.clamp(min=1e-10)
    surface = None
    if with_depth:
        surface = depth_to_normals(expected if depth_mode == "expected" else median, viewmats, Ks)
    parts = [color] if "RGB" in render_mode else []
    parts += [expected if "ED" in render_mode else depth] if with_depth else []
    image = over_backgrounds(backgrounds, torch.cat(parts, -1), alpha, render_mode)
    ids, radii, means2d, depths, normals = joined(projected)
    meta = pair_meta([len(of_camera[0]) for of_camera in projected], width, height) | {
        "gaussian_ids": ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "normals": normals,
        "opacities": torch.from_numpy(arrays["opacities"])[ids],
        "render_distort": distort,
    }
    return image, alpha, normal, surface, distort, median, meta


def _rasterize_by_gsplat(*scene: Tensor, **options: Any) -> tuple[Any, ...]:
    """Returns the results of `rasterize_surfels` without backgrounds: gsplat 1.5.3 fails on them,
    gives meta of invisible pairs too, and normals of one camera without its dimension."""
    gsplat = import_extra("gsplat", "cuda")
    *geometry, colors, viewmats, Ks = scene
    if options["sh_degree"] is None:
        colors = colors.expand(len(viewmats), len(geometry[0]), -1)
    image, alpha, normals, surface, distort, median, dense = gsplat.rasterization_2dgs(
        *geometry, colors, viewmats, Ks, **options
    )
    if surface is not None:
        surface = surface.reshape(normals.shape)
    visible = (dense["radii"] > 0).all(dim=-1)  # (C, N)
    camera_ids, gaussian_ids = visible.nonzero(as_tuple=True)
    pairs = "depths", "opacities", "radii", "means2d", "normals"
    meta = dense | {name: dense[name][visible] for name in pairs}
    R_WC = torch.linalg.inv(viewmats)[camera_ids, :3, :3]
    meta["normals"] = (R_WC @ meta["normals"][..., None])[..., 0]
    meta |= {"camera_ids": camera_ids, "gaussian_ids": gaussian_ids}
    return image, alpha, normals, surface, distort, median, meta
