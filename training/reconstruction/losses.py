"""What reconstruction minimises: photometric and log-depth losses, each with its gradient at once.

For float32 tensors on the CPU, value and gradient come from one pass of native code, on one thread;
any other device or dtype takes the same formulas through torch's autograd. Only what is rendered
has a gradient: the truth is data.
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
from splatpilot.systems.splats.background import FAR
from splatpilot.training.reconstruction.quaternions import rotate

WINDOW = 11  # [px] of SSIM
SIGMA = 1.5  # [px]
C1, C2 = 0.01**2, 0.03**2


def photometric_loss(rendered: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """
    (1 - w) L1 + w (1 - SSIM): the loss of 3D Gaussian splatting (Kerbl et al. 2023).

    L1 is the mean absolute difference. SSIM is the mean, over pixels and channels, of Wang et al.
    2004 with a Gaussian window of 11 x 11 pixels and sigma 1.5, K1 = 0.01, K2 = 0.03 and a dynamic
    range of 1; outside the image there are zeros.

    Args:
        rendered: (..., H, W, C), values about [0, 1].
        target: as `rendered`; the truth.
        ssim_weight: w, in [0, 1].

    Returns:
        A scalar; NaN if an image holds one.

    Raises:
        ValueError: the images differ in shape, dtype or device, are empty or not of floating-point
            numbers, `target` wants a gradient, or the weight is not in [0, 1].
    """
    _check_pair("rendered", rendered, "target", target)
    if rendered.ndim < 3:
        raise ValueError(f"rendered has shape {tuple(rendered.shape)}; it must be (..., H, W, C)")
    if not 0 <= ssim_weight <= 1:
        raise ValueError(f"ssim_weight is {ssim_weight}; it must lie between 0 and 1")
    if _is_native(rendered):
        shape, native = (-1, *rendered.shape[-3:]), _native.photometric_loss
        loss = _Fused.apply(rendered, native, shape, {"target": target, "ssim_weight": ssim_weight})
        return loss  # pyright: ignore[reportReturnType]
    return photometric_loss_torch(rendered, target, ssim_weight)


def log_depth_loss(
    rendered: Tensor,
    depth: Tensor,
    weights: Tensor | None = None,
    *,
    epsilon: float = 1e-3,
    far: float = FAR,
) -> Tensor:
    """
    1 / |V| sum over V of weight |log max(rendered, epsilon) - log max(depth, epsilon)|, where
    V = {pixels: epsilon < depth < far}.

    The same relative error costs the same at any range. A depth that is unknown (NaN), zero or
    infinite is in no way compared. With nothing to compare the loss is 0.

    Args:
        rendered: (...) expected or accumulated depth [m].
        depth: as `rendered`; the truth.
        weights: as `rendered`; for example from `depth_edge_weights`. 1 when None.
        epsilon, far: what depths count [m].

    Returns:
        A scalar; NaN if `rendered` is NaN or infinite in V.

    Raises:
        ValueError: the images differ in shape, dtype or device, are empty or not of floating-point
            numbers, the truth or the weights want a gradient, or not 0 < epsilon < far.
    """
    _check_pair("rendered", rendered, "depth", depth)
    if weights is not None:
        _check_pair("rendered", rendered, "weights", weights)
    if not 0 < epsilon < far:
        raise ValueError(f"depth range is {epsilon} to {far} m; it must satisfy 0 < epsilon < far")
    if _is_native(rendered):
        native = _native.log_depth_loss
        truth = {"depth": depth, "weights": weights, "epsilon": epsilon, "far": far}
        loss = _Fused.apply(rendered, native, (-1,), truth)
        return loss  # pyright: ignore[reportReturnType]
    return log_depth_loss_torch(rendered, depth, weights, epsilon, far)


def depth_edge_weights(
    depth: Tensor,
    *,
    jump: float = 0.1,
    radius: int = 2,
    gain: float = 4.0,
    epsilon: float = 1e-3,
    far: float = FAR,
) -> Tensor:
    """
    Weights for `log_depth_loss` that keep thin structures: 1 + gain within `radius` pixels of a
    discontinuity of the true depth, 1 elsewhere. Compute them once per image.

    Planes of any slant have an inverse depth that is linear in the pixel coordinates. A pixel lies
    at a discontinuity if the second difference of the inverse depth, along a row or a column,
    exceeds `jump` times the largest of the three inverse depths: about where the depth jumps by
    more than that fraction. Beyond `far`, sky included, is taken as at `far`, so that a branch
    before the sky has edges; unknown depth (NaN, or at most epsilon) makes none.

    Args:
        depth: (..., H, W) the true depth [m].
        jump: least relative jump.
        radius: how far weights reach [px].
        gain: what is added to the weight of 1.

    Returns:
        As `depth`.

    Raises:
        ValueError: `depth` is no image, or jump, radius or gain is negative.
    """
    if depth.ndim < 2 or not depth.is_floating_point() or depth.numel() == 0:
        raise ValueError(
            f"depth is {depth.dtype} {tuple(depth.shape)}; it must be floating-point (..., H, W)"
        )
    if jump < 0 or radius < 0 or gain < 0:
        raise ValueError(f"jump {jump}, radius {radius}, gain {gain}: none may be negative")
    inverse = torch.where(depth > epsilon, 1.0 / depth.clamp(max=far), torch.nan)
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
    near = max_pool2d(image, 2 * radius + 1, stride=1, padding=radius)
    return 1 + gain * near.reshape(depth.shape)


def photometric_loss_torch(rendered: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """`photometric_loss` by torch alone, on any device and dtype, unchecked."""
    l1 = (rendered - target).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(rendered, target).mean())


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """Computes the structural similarity (N, C, H, W) about each pixel of N images (..., H, W, C),
    with the window of `photometric_loss`."""
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


def log_depth_loss_torch(
    rendered: Tensor, depth: Tensor, weights: Tensor | None, epsilon: float, far: float
) -> Tensor:
    """`log_depth_loss` by torch alone, on any device and dtype, unchecked."""
    valid = (depth > epsilon) & (depth < far)
    rendered, depth = rendered[valid], depth[valid]
    loss = (rendered.clamp(min=epsilon).log() - depth.log()).abs()
    if weights is not None:
        loss = weights[valid] * loss
    # Infinite renders are mistakes as NaN is: x - x is NaN for both.
    return (loss + (rendered - rendered).detach()).sum() / max(depth.numel(), 1)


class _Fused(torch.autograd.Function):
    """A loss of native code, which makes the gradient by the first tensor with the value."""

    @staticmethod
    def forward(
        ctx: Any,
        rendered: Tensor,
        loss: Callable[..., float],
        shape: tuple[int, ...],
        truth: dict[str, Any],
    ) -> Tensor:
        def argument(x: Any) -> Any:
            return x.detach().contiguous().view(shape).numpy() if isinstance(x, Tensor) else x

        gradient = torch.empty(rendered.shape) if ctx.needs_input_grad[0] else None
        images = truth | {"rendered": rendered, "gradient": gradient}
        arguments = {name: argument(x) for name, x in images.items()}
        value = loss(**arguments, simd=os.environ.get("SPLATPILOT_SIMD", ""))
        ctx.gradient = gradient
        return rendered.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_value: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return ctx.gradient * grad_value, *(None for _ in ctx.needs_input_grad[1:])


def _is_native(rendered: Tensor) -> bool:
    return rendered.device.type == "cpu" and rendered.dtype == torch.float32


def _check_pair(name: str, rendered: Tensor, other_name: str, other: Tensor) -> None:
    """Raises ValueError unless the second can be compared with the first, as a constant."""
    if other.shape != rendered.shape:
        raise ValueError(
            f"{name} has shape {tuple(rendered.shape)} but {other_name} {tuple(other.shape)}; they "
            "must agree"
        )
    if other.dtype != rendered.dtype or other.device != rendered.device:
        raise ValueError(
            f"{name} is {rendered.dtype} on {rendered.device} but {other_name} is {other.dtype} on "
            f"{other.device}; convert one with .to()"
        )
    if not rendered.is_floating_point() or rendered.numel() == 0:
        raise ValueError(
            f"{name} is {rendered.dtype} of shape {tuple(rendered.shape)}; it must hold "
            "floating-point numbers, for images divided by 255, and at least one"
        )
    if other.requires_grad:
        raise ValueError(f"{other_name} wants a gradient, but only {name} has one: detach it")


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
