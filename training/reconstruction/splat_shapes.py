"""Scales and opacities of Gaussians from the numbers that are optimised, and back."""

import os
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native


def splat_shapes(
    log_scales: Tensor, logit_opacities: Tensor, smallest: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns scales (N, 3) = sqrt(exp(2 log_scales) + smallest^2) [m] and opacities (N,), the
    sigmoid of their logits.

    float32 tensors on the CPU go through native code, there and back in one pass each.

    Args:
        log_scales: (N, 3).
        logit_opacities: (N,).
        smallest: (N,) [m], data.
    """
    if log_scales.device.type == "cpu" and log_scales.dtype == torch.float32:
        return _Shapes.apply(log_scales, logit_opacities, smallest)  # pyright: ignore[reportReturnType]
    scales = torch.sqrt(torch.exp(2 * log_scales) + smallest[:, None] ** 2)
    return scales, torch.sigmoid(logit_opacities)


class _Shapes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, log_scales: Tensor, logit_opacities: Tensor, smallest: Tensor
    ) -> tuple[Tensor, Tensor]:
        scales, opacities = torch.empty_like(log_scales), torch.empty_like(logit_opacities)
        _native.splat_shapes(
            log_scales=log_scales.detach().numpy(),
            logit_opacities=logit_opacities.detach().numpy(),
            smallest=smallest.numpy(),
            scales=scales.numpy(),
            opacities=opacities.numpy(),
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        ctx.save_for_backward(scales, opacities, smallest)
        return scales, opacities

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_scales: Tensor, v_opacities: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        scales, opacities, smallest = ctx.saved_tensors
        v_log_scales, v_logits = torch.empty_like(scales), torch.empty_like(opacities)
        _native.splat_shapes_backward(
            scales=scales.detach().numpy(),
            opacities=opacities.detach().numpy(),
            smallest=smallest.numpy(),
            v_scales=v_scales.contiguous().numpy(),
            v_opacities=v_opacities.contiguous().numpy(),
            v_log_scales=v_log_scales.numpy(),
            v_logit_opacities=v_logits.numpy(),
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        return v_log_scales, v_logits, None
