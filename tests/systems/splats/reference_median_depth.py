"""Median depth in float64, straight from its definition, to test against."""

import torch
from reference_rasterizer import ALPHA_CUT, rotation_matrices
from torch import Tensor

NEAR = 0.01  # [m]


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

    The density of a Gaussian along the ray t d, d of unit depth, is greatest at t = l / q with
    l = d . S^-1 c and q = d . S^-1 d, for the covariance S and the centre c in the camera frame;
    there its exponent is -1/2 (c . S^-1 c - l^2 / q). Also returns how near (H, W) an alpha or what
    is left came to a threshold.
    """
    arguments = (a.double() for a in (means, quats, scales, opacities, viewmat, K))
    means, quats, scales, opacities, viewmat, K = arguments
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p_C = means @ R.T + t
    ids = torch.argsort(p_C[:, 2], stable=True)
    ids = ids[p_C[ids, 2] > NEAR]
    p_C = p_C[ids]
    axes = R @ rotation_matrices(quats[ids])
    white = axes.transpose(1, 2) / scales[ids][:, :, None]  # S^-1 = white^T white
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (u.double() - K[0, 2]) / K[0, 0], (v.double() - K[1, 2]) / K[1, 1]
    rays = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)
    d = torch.einsum("gij,pj->pgi", white, rays)
    c = torch.einsum("gij,gj->gi", white, p_C)
    depths = (d * c).sum(-1) / d.square().sum(-1)
    raw = opacities[ids] * torch.exp(-0.5 * (c - depths[..., None] * d).square().sum(-1))
    raw = torch.where(depths > 0, raw, 0.0)
    alpha = torch.where(raw >= ALPHA_CUT, raw, 0.0)
    left = torch.cumprod(1 - alpha, 1)
    passed = left <= 0.5
    first = passed.double().argmax(1)
    depth = torch.where(passed.any(1), depths.gather(1, first[:, None])[:, 0], 0.0)
    margin = torch.minimum((raw / ALPHA_CUT - 1).abs().amin(1), (left / 0.5 - 1).abs().amin(1))
    return depth.reshape(height, width), margin.reshape(height, width)
