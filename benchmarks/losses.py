"""Times the fused losses, value and gradient, against torch's autograd on one thread.

    python benchmarks/losses.py

Three ways to the same numbers in torch: the windows of SSIM as one 11 x 11 convolution, as most
trainers of splats have it; as two of 11, `photometric_loss_torch`; and for log depth
`log_depth_loss_torch`. "whole call" is the function with its checks and autograd, "kernel" the
native code alone. Times are CPU milliseconds; on a busy machine the minimum is what to read.
Accuracy is against torch in float64.
"""

from collections.abc import Callable

import torch
from harness import header, machine, milliseconds, row
from torch import Tensor
from torch.nn.functional import conv2d

from splatpilot import _native
from splatpilot.training.reconstruction.losses import (
    C1,
    C2,
    SIGMA,
    WINDOW,
    depth_edge_weights,
    log_depth_loss,
    log_depth_loss_torch,
    photometric_loss,
    photometric_loss_torch,
)

SSIM_WEIGHT = 0.2
EPSILON, FAR = 1e-3, 150.0  # [m]

Loss = Callable[[Tensor], Tensor]
Losses = dict[str, Loss]
Kernel = Callable[[str], None]  # given the SIMD level


def photometric_by_squares(rendered: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """`photometric_loss` with windows of 11 x 11, channels as groups."""
    x, y = (t.movedim(-1, 0)[None] for t in (rendered, target))
    offset = torch.arange(WINDOW, dtype=x.dtype) - WINDOW // 2
    row = torch.exp(-(offset**2) / (2 * SIGMA**2))
    window = torch.outer(row, row)
    window = (window / window.sum()).expand(x.shape[1], 1, WINDOW, WINDOW).contiguous()

    def mean(image: Tensor) -> Tensor:
        return conv2d(image, window, padding=WINDOW // 2, groups=x.shape[1])

    mean_x, mean_y = mean(x), mean(y)
    var_x, var_y = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2
    covariance = mean(x * y) - mean_x * mean_y
    ssim = ((2 * mean_x * mean_y + C1) * (2 * covariance + C2)) / (
        (mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2)
    )
    return (1 - ssim_weight) * (x - y).abs().mean() + ssim_weight * (1 - ssim.mean())


def scene(width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rendered and true image (H, W, 3), rendered and true depth (H, W)."""
    rng = torch.Generator().manual_seed(0)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pattern = 0.5 + 0.4 * torch.sin(u / 9.0) * torch.cos(v / 13.0)
    target = torch.stack([pattern, pattern**2, 1 - pattern], dim=-1)
    rendered = (target + 0.03 * torch.randn(target.shape, generator=rng)).clamp(0, 1)
    depth = torch.where((u // 40 + v // 30) % 3 == 0, 3.0, 1 / (0.002 + 0.001 * v))
    noisy = depth * torch.exp(0.05 * torch.randn(depth.shape, generator=rng))
    return rendered, target, noisy, depth


def table(name: str, size: str, rendered: Tensor, losses: Losses, kernel: Kernel) -> None:
    """Prints the rows of one loss; the last of `losses`, in float64, is the measure of accuracy."""

    def gradient_of(loss: Loss, x: Tensor) -> Tensor:
        x = x.detach().requires_grad_()
        loss(x).backward()
        assert x.grad is not None
        return x.grad

    for level in _native.simd_levels():
        least, median = milliseconds(lambda level=level: kernel(level))
        row(name, size, f"fused, kernel, {level}", f"{least:.3f}", f"{median:.3f}", "", "")
    expected = gradient_of(list(losses.values())[-1], rendered.double())
    fused = 0.0
    for how, loss in losses.items():
        error = (gradient_of(loss, rendered) - expected).abs().max() / expected.abs().max()
        least, median = milliseconds(lambda loss=loss: gradient_of(loss, rendered))
        fused = fused or least
        row(
            name, size, how, f"{least:.3f}", f"{median:.3f}", f"{least / fused:.1f}", f"{error:.1e}"
        )


def main() -> None:
    torch.set_num_threads(1)
    print(machine())
    header("loss", "size", "how", "min ms", "median ms", "times fused", "gradient error")
    for width, height in ((160, 120), (320, 240), (640, 480)):
        rendered, target, noisy, depth = scene(width, height)
        weights = depth_edge_weights(depth)
        gradient = torch.empty_like(rendered)

        def photometric_kernel(level: str, x=rendered, y=target, out=gradient) -> None:
            _native.photometric_loss(
                rendered=x[None].numpy(),
                target=y[None].numpy(),
                ssim_weight=SSIM_WEIGHT,
                gradient=out[None].numpy(),
                simd=level,
            )

        def log_depth_kernel(level: str, x=noisy, d=depth, w=weights, out=gradient) -> None:
            rendered, truth, weight = (t.view(-1).numpy() for t in (x, d, w))
            _native.log_depth_loss(
                rendered=rendered,
                depth=truth,
                weights=weight,
                epsilon=EPSILON,
                far=FAR,
                gradient=out.view(-1)[: x.numel()].numpy(),
                simd=level,
            )

        def photometric(loss: Callable[..., Tensor], y=target) -> Loss:
            return lambda x: loss(x, y.to(x.dtype), SSIM_WEIGHT)

        def log_depth_by_torch(x: Tensor, d=depth, w=weights) -> Tensor:
            return log_depth_loss_torch(x, d.to(x.dtype), w.to(x.dtype), EPSILON, FAR)

        def log_depth(x: Tensor, d=depth, w=weights) -> Tensor:
            return log_depth_loss(x, d, w, epsilon=EPSILON, far=FAR)

        photometric_losses = {
            "fused, whole call": photometric(photometric_loss),
            "torch, 11 x 11": photometric(photometric_by_squares),
            "torch, 2 x 11": photometric(photometric_loss_torch),
        }
        log_depth_losses = {"fused, whole call": log_depth, "torch": log_depth_by_torch}
        size = f"{width}x{height}"
        table("L1 + SSIM", size, rendered, photometric_losses, photometric_kernel)
        table("log depth", size, noisy, log_depth_losses, log_depth_kernel)


if __name__ == "__main__":
    main()
