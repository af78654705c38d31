"""The two collision signals of a signed distance: hard indicator and soft barrier."""

import sys
from typing import Any

import numpy as np


def soft_barrier(distance: Any, radius: float, beta: float = 4.0, margin: float = 1.0) -> Any:
    """Differentiable collision penalty, near zero in free space (equation 3).

        soft(d) = softplus(beta (radius + margin - d)) / beta

    Stable for any finite distance: it neither overflows deep inside an obstacle nor loses its tail
    far away from one.

    Args:
        distance: (...,) [m], signed distance; numpy array, float or torch tensor.
        radius: of the vehicle [m].
        beta: sharpness [1/m].
        margin: distance kept beyond the radius [m].

    Returns:
        (...,) [m], of the distance's kind; NaN where the distance is NaN.

    Raises:
        ValueError: if beta is not positive.
    """
    if not beta > 0.0:
        raise ValueError(f"soft_barrier: beta is {beta} 1/m; it must be positive.")
    exponent = beta * (radius + margin - distance)
    torch = sys.modules.get("torch")  # Whoever holds a tensor has imported torch.
    if torch is not None and isinstance(exponent, torch.Tensor):
        return torch.logaddexp(exponent, torch.zeros_like(exponent)) / beta
    with np.errstate(invalid="ignore"):  # NaN in, NaN out, without a warning
        return np.logaddexp(exponent, 0.0) / beta


def in_collision(distance: Any, radius: float) -> Any:
    """Whether a vehicle of this radius [m] touches an obstacle at this signed distance (...,) [m].

    False where the distance is NaN: outside a field nothing is known to be hit.
    """
    return distance < radius
