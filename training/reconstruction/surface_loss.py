"""What holds Gaussians to the surfaces that depth shows, and these to their outlines."""

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.splats.background import FAR
from splatpilot.training.reconstruction.quaternions import rotate

# Of its depth, how far from a surface a point may stand to belong to it.
_REACH = 0.05
# [m], nearer to the camera than this a pixel says nothing about a point.
_NEAREST = 0.05


def surface_loss(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    depth: Tensor,
    rng: np.random.Generator,
) -> Tensor:
    """Returns the mean of |log z - log depth| over a point drawn from each Gaussian, of those
    points that belong to what is seen.

    Expected depth is right already where some layers of a surface stand before it and others
    behind, and where Gaussians are thick or askew; then the median is wrong. So the mass of each
    Gaussian is drawn to the surface: every point that is seen within 5 % of the true depth at its
    pixel is drawn to that depth, and none across the edge of a thing. Centres move, thick ones
    flatten, and those askew turn.

    Args:
        means, quats, scales: (N, 3) [m], (N, 4) and (N, 3) [m], of Gaussians that may be seen.
        viewmat: (4, 4) world to camera.
        K: (3, 3) [px].
        depth: (H, W) [m], the truth.
        rng: draws the points.
    """
    drawn = rng.standard_normal(means.shape, np.float32)
    offset = torch.from_numpy(drawn).to(means.device) * scales
    p_WQ = means + rotate(quats, offset)
    p_CQ = p_WQ @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = p_CQ[:, 2]
    height, width = depth.shape
    with torch.no_grad():
        u, v, _ = (p_CQ / z.clamp(min=_NEAREST)[:, None] @ K.T).floor().long().unbind(dim=1)
        inside = (z > _NEAREST) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        truth = depth[v.clamp(0, height - 1), u.clamp(0, width - 1)]
        known = inside & (truth > 0) & (truth < FAR)
        near = known & ((z - truth).abs() < _REACH * truth)
    return (z[near] / truth[near]).log().abs().sum() / near.sum().clamp(min=1)


def outline_loss(alpha: Tensor, depth: Tensor, weights: Tensor) -> Tensor:
    """Returns the mean of weight |alpha - 1| where there is a surface and of weight alpha before
    the infinitely far, over the pixels whose depth is known.

    Colours alone leave the last pixel of a thing before the sky half there.

    Args:
        alpha: (H, W), what is rendered.
        depth: (H, W) [m], the truth.
        weights: (H, W), for example from `depth_edge_weights`.
    """
    solid = ((depth > 0) & (depth < FAR)).to(alpha.dtype)
    known = depth > 0
    return ((alpha - solid).abs() * weights * known).sum() / known.sum().clamp(min=1)
