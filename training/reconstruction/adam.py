"""Adam (Kingma and Ba 2015) for single tensors."""

import math
import os

import torch
from torch import Tensor

from splatpilot import _native

MEAN_DECAY, SQUARE_DECAY = 0.9, 0.999
EPSILON = 1e-15
"""Of 3D Gaussian splatting: gradients of single Gaussians are tiny."""


@torch.no_grad()
def adam_step(
    parameters: Tensor, gradients: Tensor, mean: Tensor, square: Tensor, rate: float, step: int
) -> None:
    """Moves `parameters` by `rate` down their gradients, and with these the moving averages `mean`
    of them and `square` of their squares, all of one shape.

    float32 tensors on the CPU go through native code in one pass.

    Args:
        step: 1 for the first.
    """
    if gradients.device.type == "cpu" and gradients.dtype == torch.float32:
        _native.adam_step(
            parameters=parameters.detach().view(-1).numpy(),
            gradients=gradients.contiguous().view(-1).numpy(),
            means=mean.view(-1).numpy(),
            squares=square.view(-1).numpy(),
            rate=rate,
            step=step,
            mean_decay=MEAN_DECAY,
            square_decay=SQUARE_DECAY,
            epsilon=EPSILON,
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        return
    mean.lerp_(gradients, 1 - MEAN_DECAY)
    square.mul_(SQUARE_DECAY).addcmul_(gradients, gradients, value=1 - SQUARE_DECAY)
    deviation = square.sqrt() / math.sqrt(1 - SQUARE_DECAY**step) + EPSILON
    parameters.addcdiv_(mean, deviation, value=-rate / (1 - MEAN_DECAY**step))
