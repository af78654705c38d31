"""What holds Gaussians to the surfaces that depth shows, and these to their outlines."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
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
    seen: Tensor,
    viewmat: Tensor,
    K: Tensor,
    depth: Tensor,
    rng: np.random.Generator,
) -> Tensor:
    """Returns the mean of |log z - log depth| over a point drawn from each Gaussian of `seen`, of
    those points that belong to what is seen.

    Expected depth is right already where some layers of a surface stand before it and others
    behind, and where Gaussians are thick or askew; then the median is wrong. So the mass of each
    Gaussian is drawn to the surface: every point that is seen within 5 % of the true depth at its
    pixel is drawn to that depth, and none across the edge of a thing. Centres move, thick ones
    flatten, and those askew turn.

    float32 tensors on the CPU go through native code, which makes value and gradient at once.

    Args:
        means, quats, scales: (N, 3) [m], (N, 4) and (N, 3) [m], of all Gaussians.
        seen: (M,) numbers of those that may be seen.
        viewmat: (4, 4) world to camera.
        K: (3, 3) [px].
        depth: (H, W) [m], the truth.
        rng: draws the points.
    """
    draws = torch.from_numpy(rng.standard_normal((len(seen), 3), np.float32))
    if means.device.type == "cpu" and means.dtype == torch.float32:
        found = _NativeSurfaceLoss.apply(means, quats, scales, seen, draws, viewmat, K, depth)
        return found  # pyright: ignore[reportReturnType]
    return surface_loss_torch(means, quats, scales, seen, draws, viewmat, K, depth)


def surface_loss_torch(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    seen: Tensor,
    draws: Tensor,
    viewmat: Tensor,
    K: Tensor,
    depth: Tensor,
) -> Tensor:
    """`surface_loss` by torch alone, on any device and dtype.

    Args:
        draws: (M, 3), standard normal: where the points are, in standard deviations.
    """
    means, quats, scales = (values.index_select(0, seen) for values in (means, quats, scales))
    p_WQ = means + rotate(quats, draws.to(means) * scales)
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


class _NativeSurfaceLoss(torch.autograd.Function):
    """`surface_loss_torch`."""

    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        means, quats, scales, seen, draws, viewmat, K, depth = arguments
        gaussians = [values.detach().contiguous() for values in (means, quats, scales)]
        ctx.gradients = [torch.zeros_like(values) for values in gaussians]
        arrays = [values.numpy() for values in (*gaussians, *ctx.gradients)]
        names = ("means", "quats", "scales", "v_means", "v_quats", "v_scales")
        loss = _native.surface_loss(
            **dict(zip(names, arrays, strict=True)),
            seen=seen.long().contiguous().numpy(),
            draws=draws.numpy(),
            X_CW=viewmat.contiguous().numpy(),
            K=K.contiguous().numpy(),
            depth=depth.contiguous().numpy(),
            reach=_REACH,
            nearest=_NEAREST,
            far=FAR,
        )
        return means.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return *(values * v_loss for values in ctx.gradients), *(None for _ in range(5))


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
