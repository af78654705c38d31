"""Times the fused losses, value and gradient, against torch's autograd on one thread.

    python benchmarks/losses.py

The peers compute the same numbers in torch, SSIM by one 11 x 11 convolution, as most trainers of
splats. Times are CPU milliseconds, with checks and autograd; errors are against torch in float64.
"""

import os
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
    photometric_loss,
)

SSIM_WEIGHT = 0.2
EPSILON, FAR = 1e-3, 150.0  # [m]

Loss = Callable[[Tensor], Tensor]


def photometric_by_torch(rendered: Tensor, target: Tensor) -> Tensor:
    """Computes `photometric_loss` with windows of 11 x 11, channels as groups."""
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
    return (1 - SSIM_WEIGHT) * (x - y).abs().mean() + SSIM_WEIGHT * (1 - ssim.mean())


def log_depth_by_torch(rendered: Tensor, depth: Tensor, weights: Tensor) -> Tensor:
    known = (depth > EPSILON) & (depth < FAR)
    error = rendered[known].clamp(min=EPSILON).log() - depth[known].log()
    return (weights[known] * error.abs()).mean()


def make_images(width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns rendered and true image (H, W, 3), rendered and true depth (H, W)."""
    rng = torch.Generator().manual_seed(0)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pattern = 0.5 + 0.4 * torch.sin(u / 9.0) * torch.cos(v / 13.0)
    target = torch.stack([pattern, pattern**2, 1 - pattern], dim=-1)
    rendered = (target + 0.03 * torch.randn(target.shape, generator=rng)).clamp(0, 1)
    depth = torch.where((u // 40 + v // 30) % 3 == 0, 3.0, 1 / (0.002 + 0.001 * v))
    noisy = depth * torch.exp(0.05 * torch.randn(depth.shape, generator=rng))
    return rendered, target, noisy, depth


def print_rows(name: str, rendered: Tensor, fused: Loss, peer: Loss) -> None:
    """Prints the rows of one loss; the peer in float64 is the truth."""

    def gradient(loss: Loss, x: Tensor) -> Tensor:
        x = x.detach().requires_grad_()
        loss(x).backward()
        assert x.grad is not None
        return x.grad

    expected = gradient(peer, rendered.double())
    fastest = 0.0
    for level in (*_native.simd_levels(), ""):
        os.environ["SPLATPILOT_SIMD"] = level
        loss = fused if level else peer
        error = (gradient(loss, rendered) - expected).abs().max() / expected.abs().max()
        time = milliseconds(lambda loss=loss: gradient(loss, rendered))
        fastest = fastest or time
        size = f"{rendered.shape[1]}x{rendered.shape[0]}"
        how = f"fused, {level}" if level else "torch"
        row(name, size, how, f"{time:.3f}", f"{time / fastest:.1f}", f"{error:.1e}")


def main() -> None:
    torch.set_num_threads(1)
    print(machine())
    header("loss", "size", "how", "ms", "times fused", "gradient error")
    for width, height in ((160, 120), (320, 240), (640, 480)):
        rendered, target, noisy, depth = make_images(width, height)
        weights = depth_edge_weights(depth)

        print_rows(
            "L1 + SSIM",
            rendered,
            lambda x, y=target: photometric_loss(x, y, SSIM_WEIGHT),
            lambda x, y=target: photometric_by_torch(x, y.to(x.dtype)),
        )
        print_rows(
            "log depth",
            noisy,
            lambda x, d=depth, w=weights: log_depth_loss(x, d, w, epsilon=EPSILON, far=FAR),
            lambda x, d=depth, w=weights: log_depth_by_torch(x, d.to(x.dtype), w.to(x.dtype)),
        )


if __name__ == "__main__":
    main()
