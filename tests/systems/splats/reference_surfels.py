"""2D Gaussian splatting in float64 torch, differentiable, from Huang et al. 2024, eq. 4 to 11:
the homography H from a surfel's plane to the image, the ray as the intersection of two planes
mapped back by H^T, and the larger of the two Gaussians."""

from typing import Any, NamedTuple

import torch
from reference_rasterizer import (
    ALPHA_CUT,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    blend,
    first_view,
    pixel_centers,
    rotation_matrices,
    seen_colors,
)
from torch import Tensor

BLOB_SIGMA = 0.5**0.5  # [px]
EDGE_ON = 1e-5


class Reference(NamedTuple):
    color: Tensor  # (H, W, 3)
    alpha: Tensor  # (H, W)
    normal: Tensor  # (H, W, 3) in the world
    depth: Tensor  # (H, W) accumulated
    median: Tensor  # (H, W)
    distort: Tensor  # (H, W)
    margin: Tensor  # (H, W) least relative distance of a quantity to the threshold it met


def render(
    scene: dict[str, Any], width: int, height: int, near=0.01, sh_degree=None, dtype=torch.float64
) -> Reference:
    means, quats, scales, opacities, colors, viewmat, K = first_view(scene, dtype)
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p_C = means @ R.T + t
    index = torch.nonzero(p_C[:, 2] >= near)[:, 0]
    index = index[torch.argsort(p_C[index, 2], stable=True)]
    p_C, axes_W, opacity = p_C[index], rotation_matrices(quats[index]), opacities[index]
    tangents_C = R @ axes_W[:, :, :2]  # (M, 3, 2)

    # Columns of H: what u, v and 1 contribute to (x z, y z, z) of a point of the surfel.
    H = K @ torch.cat([tangents_C * scales[index, None, :2], p_C[:, :, None]], 2)  # (M, 3, 3)
    normal_C = torch.linalg.cross(tangents_C[:, :, 0], tangents_C[:, :, 1])
    facing = (normal_C * p_C).sum(1)
    normal_W = axes_W[:, :, 2] * -torch.sign(facing)[:, None]
    edge_on = facing.abs() <= EDGE_ON * p_C.norm(dim=1)
    center = (p_C @ K.T)[:, :2] / p_C[:, 2:]

    seen = seen_colors(means[index], colors[index], viewmat, sh_degree)
    x, y = pixel_centers(width, height).to(dtype).unbind(-1)  # (P, 1)
    # The planes of the pixel's column and row, in the surfel's coordinates; a ray lies in both.
    h_u = x[..., None] * H[:, 2] - H[:, 0]  # (P, M, 3)
    h_v = y[..., None] * H[:, 2] - H[:, 1]
    point = torch.linalg.cross(h_u, h_v)
    parallel = point[..., 2] == 0
    uv = point[..., :2] / torch.where(parallel, 1.0, point[..., 2])[..., None]
    z = (uv * H[:, 2, :2]).sum(-1) + H[:, 2, 2]
    on_plane = (uv * uv).sum(-1)
    of_blob = ((x - center[:, 0]) ** 2 + (y - center[:, 1]) ** 2) / BLOB_SIGMA**2
    hit = ~parallel & ~edge_on & (z >= near) & (on_plane <= of_blob)
    r2 = torch.where(hit, on_plane, of_blob)
    depth = torch.where(hit, z, p_C[:, 2])

    raw = opacity * torch.exp(-r2 / 2)
    before, after, weight = blend(raw)
    front_weight = weight.cumsum(1) - weight
    front_depth = (weight * depth).cumsum(1) - weight * depth
    distort = 2 * (weight * (depth * front_weight - front_depth)).sum(1)
    ranks = torch.arange(1, len(index) + 1)
    is_median = (weight > 0) & (before > 0.5)
    last = (is_median * ranks).amax(1, keepdim=True) if len(index) else torch.zeros_like(x).long()
    median = torch.where((ranks == last) & is_median, depth, 0.0).sum(1)

    drawn = (before > MIN_TRANSMITTANCE) & (raw >= 0.9 * ALPHA_CUT)
    thresholds = [
        (raw / ALPHA_CUT - 1, before > MIN_TRANSMITTANCE),
        (raw / MAX_ALPHA - 1, drawn),
        (after / MIN_TRANSMITTANCE - 1, before > MIN_TRANSMITTANCE),
        (before / 0.5 - 1, drawn),
        (on_plane / of_blob - 1, drawn & ~edge_on),
        (z / near - 1, drawn & (on_plane <= of_blob)),
    ]
    margin = torch.stack(
        [torch.where(met, d.detach().abs(), torch.inf) for d, met in thresholds]
    ).amin(0)
    margin = torch.cat([margin, torch.full_like(x, torch.inf)], 1).amin(1)
    total = weight.sum(1)
    behind = scene.get("backgrounds", torch.zeros(1, 3))[0].to(dtype)
    color = weight @ seen + (1 - total)[:, None] * behind
    depths = (weight * depth).sum(1), median, distort, margin
    images = color, total, weight @ normal_W, *depths
    return Reference(*(image.reshape(height, width, *image.shape[1:]) for image in images))
