"""gsplat's CUDA kernels, with the results that `rasterize` and `rasterize_surfels` have.

Written for gsplat 1.5.3, which fails on backgrounds behind Gaussians that it packs, on surfels of
colours with depth, and gives of surfels what it has for every pair of camera and surfel, seen or
not, and of one camera normals without the camera's dimension.
"""

from typing import Any

import torch
from torch import Tensor

from splatpilot.systems.extras import import_extra


def rasterize_by_gsplat(
    scene: tuple[Tensor, ...], *arguments: Any, backgrounds: Tensor | None, **options: Any
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """What `rasterize` returns.

    Args:
        scene: means, quats, scales, opacities, colors and viewmats.
        arguments: Ks, width and height.
        backgrounds: (C, 3), or None.
        options: as gsplat's.
    """
    gsplat = import_extra("gsplat", "cuda")
    image, alpha, meta = gsplat.rasterization(*scene, *arguments, **options)
    return _over_backgrounds(backgrounds, image, alpha, options["render_mode"]), alpha, meta


def rasterize_surfels_by_gsplat(
    scene: tuple[Tensor, ...],
    Ks: Tensor,
    width: int,
    height: int,
    *,
    backgrounds: Tensor | None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """What `rasterize_surfels` returns; arguments as of `rasterize_by_gsplat`."""
    gsplat = import_extra("gsplat", "cuda")
    *splats, colors, viewmats = scene
    if options["sh_degree"] is None:
        colors = colors.expand(len(viewmats), len(splats[0]), -1)
    image, alpha, normals, surface, distort, median, dense = gsplat.rasterization_2dgs(
        *splats, colors, viewmats, Ks, width, height, **options
    )
    if surface is not None:
        surface = surface.reshape(normals.shape)
    seen = (dense["radii"] > 0).all(dim=-1)  # (C, N)
    camera_ids, gaussian_ids = seen.nonzero(as_tuple=True)
    pairs = "depths", "opacities", "radii", "means2d", "normals"
    meta = dense | {name: dense[name][seen] for name in pairs}
    R_WC = torch.linalg.inv(viewmats)[camera_ids, :3, :3]
    meta["normals"] = (R_WC @ meta["normals"][..., None])[..., 0]
    meta |= {"camera_ids": camera_ids, "gaussian_ids": gaussian_ids}
    image = _over_backgrounds(backgrounds, image, alpha, options["render_mode"])
    return image, alpha, normals, surface, distort, median, meta


def _over_backgrounds(
    backgrounds: Tensor | None, image: Tensor, alpha: Tensor, render_mode: str
) -> Tensor:
    """The image (C, H, W, X) with colours (C, 3) behind its own, if it has some."""
    if backgrounds is None or "RGB" not in render_mode:
        return image
    color = image[..., :3] + (1 - alpha) * backgrounds[:, None, None, :]
    return torch.cat([color, image[..., 3:]], dim=-1)
