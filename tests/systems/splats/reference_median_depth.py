"""Median depth in float64, straight from its definition, to test against."""

import torch
from reference_rasterizer import ALPHA_CUT, project, rotation_matrices
from torch import Tensor

BLUR = 0.3  # [px^2]
LEAST = 1e-8  # [px^2]
REACH = 3.33  # standard deviations


def median_depth(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """The depth (H, W) [m] at which what sharp footprints let through falls to one half, else 0.

    On a Gaussian with the covariance S about c, in the camera frame, the depth is where the ray d
    (of unit depth) meets the plane n . p = n . c with n = S^-1 c, turned until no part within
    `REACH` standard deviations is nearer or farther by more than 0.9 of the inverse depth. Where
    that is farther than the center, a distance on the image counts as much longer. Also returns
    how near (H, W) an alpha or what is left came to a threshold.
    """
    arguments = (a.double() for a in (means, quats, scales, opacities, viewmat, K))
    means, quats, scales, opacities, viewmat, K = arguments
    visible = project(means, quats, scales, opacities, viewmat, K, width, height, eps2d=BLUR)
    sharp = visible.covariance + (LEAST - BLUR) * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(sharp)

    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p_C = means[visible.ids] @ R.T + t
    factor = R @ rotation_matrices(quats[visible.ids]) * scales[visible.ids][:, None, :]
    covariance = factor @ factor.transpose(1, 2)
    n = torch.linalg.solve(covariance, p_C[..., None])[..., 0]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v], -1).reshape(-1, 1, 2).double()
    slope = n[:, :2] / torch.stack([K[0, 0], K[1, 1]]) / (n * p_C).sum(1, keepdim=True)  # (M, 2)
    spread = torch.einsum("gi,gij,gj->g", slope, sharp, slope).sqrt()
    turn = (0.9 / p_C[:, 2] / (REACH * spread)).clamp(max=1)
    inverse = 1 / p_C[:, 2] + turn * ((pixels - visible.mean) * slope).sum(-1)  # (P, M)
    d = (pixels - visible.mean) / (p_C[:, 2] * inverse).clamp(max=1)[..., None]
    raw = visible.opacity * torch.exp(-0.5 * torch.einsum("pgi,gij,pgj->pg", d, conic, d))
    alpha = torch.where(raw >= ALPHA_CUT, raw, 0.0)
    left = torch.cumprod(1 - alpha, 1)
    passed = left <= 0.5
    first = passed.double().argmax(1)
    depth = torch.where(passed.any(1), 1 / inverse.gather(1, first[:, None])[:, 0], 0.0)
    margin = torch.minimum((raw / ALPHA_CUT - 1).abs().amin(1), (left / 0.5 - 1).abs().amin(1))
    return depth.reshape(height, width), margin.reshape(height, width)
