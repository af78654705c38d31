"""Losses of reconstruction: photometric, log-depth, surface and outline.

float32 tensors on the CPU take native code, which computes value and gradient in one pass; other
tensors take the same formulas by torch. Only what is rendered has a gradient.
"""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d, max_pool2d

from splatpilot import _native
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.vehicle.state import rotation_matrices

WINDOW = 11  # [px] of SSIM
SIGMA = 1.5  # [px]
C1, C2 = 0.01**2, 0.03**2

_EPSILON = 1e-3  # [m], minimum depth
_EDGE_RADIUS, _EDGE_GAIN = 2, 4.0  # [px], and additional weight
_REACH = 0.05  # distance of a point from its surface, as a fraction of the depth
_NEAR = 0.05  # [m], minimum depth of a point


def photometric_loss(rendered: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """Computes (1 - w) L1 + w (1 - SSIM), the loss of 3D Gaussian splatting (Kerbl et al. 2023), of
    images (..., H, W, C) with values about [0, 1].

    SSIM is the mean, over pixels and channels, of Wang et al. 2004 with a Gaussian window of 11 x
    11 pixels and sigma 1.5, K1 = 0.01, K2 = 0.03, a dynamic range of 1 and zeros outside the image.
    """
    _check_pair("rendered", rendered, "target", target)
    require(rendered.ndim >= 3, "rendered", "(..., H, W, C)", tuple(rendered.shape))
    require(0 <= ssim_weight <= 1, "ssim_weight", "in [0, 1]", ssim_weight)
    if _is_native(rendered):
        rendered, target = (x.reshape(-1, *x.shape[-3:]) for x in (rendered, target))
        truth = {"target": target, "ssim_weight": ssim_weight, "simd": _simd()}
        return _Native.apply(_native.photometric_loss, truth, "rendered gradient", rendered)  # pyright: ignore[reportReturnType]
    l1 = (rendered - target).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(rendered, target).mean())


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """Computes SSIM (N, C, H, W) about each pixel of N images (..., H, W, C)."""
    height, width, channels = rendered.shape[-3:]
    x, y = (t.reshape(-1, height, width, channels).movedim(-1, 1) for t in (rendered, target))
    offset = torch.arange(WINDOW, dtype=x.dtype, device=x.device) - WINDOW // 2
    window = torch.exp(-(offset**2) / (2 * SIGMA**2))
    window = (window / window.sum()).expand(5 * channels, 1, 1, WINDOW)
    # One channel for each of five windowed means.
    maps = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    maps = conv2d(maps, window, padding=(0, WINDOW // 2), groups=5 * channels)
    maps = conv2d(maps, window.mT, padding=(WINDOW // 2, 0), groups=5 * channels)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = maps.chunk(5, dim=1)
    variances = mean_xx + mean_yy - mean_x**2 - mean_y**2
    covariance = mean_xy - mean_x * mean_y
    return ((2 * mean_x * mean_y + C1) * (2 * covariance + C2)) / (
        (mean_x**2 + mean_y**2 + C1) * (variances + C2)
    )


def log_depth_loss(rendered: Tensor, depth: Tensor, weights: Tensor | None = None) -> Tensor:
    """Computes 1 / |V| sum over V of weight |log max(rendered, epsilon) - log depth|, where V =
    {pixels: epsilon < depth < far}, from 1 mm to 150 m; 0 if V is empty. Depths (...) are expected
    or accumulated, and true, in [m]; weights are 1 by default."""
    _check_pair("rendered", rendered, "depth", depth)
    if weights is not None:
        _check_pair("rendered", rendered, "weights", weights)
    if _is_native(rendered):
        weights = None if weights is None else weights.ravel()
        truth = {"depth": depth.ravel(), "weights": weights, "epsilon": _EPSILON, "far": FAR}
        truth["simd"] = _simd()
        return _Native.apply(_native.log_depth_loss, truth, "rendered gradient", rendered.ravel())  # pyright: ignore[reportReturnType]
    valid = (depth > _EPSILON) & (depth < FAR)
    rendered, depth = rendered[valid], depth[valid]
    loss = (rendered.clamp(min=_EPSILON).log() - depth.log()).abs()
    if weights is not None:
        loss = weights[valid] * loss
    # x - x is NaN for NaN and for infinity, which the clamp would hide.
    return (loss + (rendered - rendered).detach()).sum() / max(depth.numel(), 1)


def depth_edge_weights(depth: Tensor, jump: float = 0.1, far: float = FAR) -> Tensor:
    """Returns weights for `log_depth_loss` that keep thin structures: 5 within 2 pixels of a
    discontinuity of the true depth (..., H, W) [m], 1 elsewhere.

    That is where the second difference of inverse depth, which is linear on planes, along a row or
    a column, exceeds `jump` times the largest of the three. Depth beyond `far` [m] counts as `far`,
    so that a branch before the sky has edges; unknown depth (NaN, or at most 1 mm) makes none.
    """
    inverse = torch.where(depth > _EPSILON, 1.0 / depth.clamp(max=far), torch.nan)
    edge = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (-2, -1):
        length = depth.shape[axis] - 2
        if length < 1:
            continue
        a, b, c = (inverse.narrow(axis, k, length) for k in range(3))
        second = (a - 2 * b + c).abs()
        edge.narrow(axis, 1, length).logical_or_(
            second > jump * torch.maximum(torch.maximum(a, b), c)
        )
    image = edge.to(depth.dtype).reshape(-1, 1, *depth.shape[-2:])
    near = max_pool2d(image, 2 * _EDGE_RADIUS + 1, stride=1, padding=_EDGE_RADIUS)
    return 1 + _EDGE_GAIN * near.reshape(depth.shape)


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
    """Returns the mean of |log z - log depth| over a point, drawn by `rng`, from each Gaussian of
    `seen` (M,), for points within 5 % of the true depth (H, W) [m] at their pixel.

    It moves Gaussians to the surface, flattens and aligns them, so that the median depth is right.
    Means (N, 3) [m], quats (N, 4) and scales (N, 3) [m] are of all Gaussians, `viewmat` (4, 4) is
    world to camera.
    """
    draws = torch.from_numpy(rng.standard_normal((len(seen), 3), np.float32))
    if _is_native(means):
        view = {"seen": seen.long(), "draws": draws, "X_CW": viewmat, "K": K, "depth": depth}
        view |= {"reach": _REACH, "nearest": _NEAR, "far": FAR}
        names = "means quats scales v_means v_quats v_scales"
        return _Native.apply(_native.surface_loss, view, names, means, quats, scales)  # pyright: ignore[reportReturnType]
    means, quats, scales = (values.index_select(0, seen) for values in (means, quats, scales))
    offsets = rotation_matrices(quats) @ (draws.to(means) * scales)[..., None]
    p_CQ = (means + offsets[..., 0]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = p_CQ[:, 2]
    height, width = depth.shape
    with torch.no_grad():
        u, v, _ = (p_CQ / z.clamp(min=_NEAR)[:, None] @ K.T).floor().long().unbind(dim=1)
        inside = (z > _NEAR) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        truth = depth[v.clamp(0, height - 1), u.clamp(0, width - 1)]
        known = inside & (truth > 0) & (truth < FAR)
        near = known & ((z - truth).abs() < _REACH * truth)
    return (z[near] / truth[near]).log().abs().sum() / near.sum().clamp(min=1)


def outline_loss(alpha: Tensor, depth: Tensor, weights: Tensor) -> Tensor:
    """Returns the mean of weight |alpha - 1| on surfaces and of weight alpha in the sky, over the
    pixels (H, W) whose depth is known; color leaves the last pixel before the sky half transparent.
    """
    solid = ((depth > 0) & (depth < FAR)).to(alpha.dtype)
    known = depth > 0
    return ((alpha - solid).abs() * weights * known).sum() / known.sum().clamp(min=1)


class _Native(torch.autograd.Function):
    """A native loss of tensors and constants; `names` are those of the tensors and gradients."""

    @staticmethod
    def forward(
        ctx: Any, loss: Callable[..., float], constants: dict[str, Any], names: str, *inputs: Tensor
    ) -> Tensor:
        def array(x: Any) -> Any:
            return x.detach().contiguous().numpy() if isinstance(x, Tensor) else x

        ctx.gradients = [torch.zeros(x.shape) for x in inputs]
        given = dict(zip(names.split(), [*inputs, *ctx.gradients], strict=True)) | constants
        return inputs[0].new_tensor(loss(**{name: array(x) for name, x in given.items()}))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, None, None, *(gradient * v_loss for gradient in ctx.gradients)


def _simd() -> str:
    return os.environ.get("SPLATPILOT_SIMD", "")


def _is_native(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32


def _check_pair(name: str, rendered: Tensor, other_name: str, other: Tensor) -> None:
    """Raises ValueError unless `other` can be compared with `rendered`, as a constant."""
    floating = rendered.is_floating_point() and rendered.numel() > 0
    what = f"{rendered.dtype} {tuple(rendered.shape)}"
    require(floating, name, "floating-point and not empty", what, "divide images by 255")
    same = (other.shape, other.dtype, other.device)
    like = (rendered.shape, rendered.dtype, rendered.device)
    condition = f"{tuple(rendered.shape)} {rendered.dtype} on {rendered.device}, as {name}"
    what = f"{tuple(other.shape)} {other.dtype} on {other.device}"
    require(same == like, other_name, condition, what)
    require(not other.requires_grad, other_name, "without gradient", "requires_grad", "detach it")
