"""What every distance field answers: signed distance, its gradient and what is known there."""

import sys
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike


class FieldState(IntEnum):
    """What is known of a point of space.

    The numbers are part of the `esdf.npz` format.
    """

    FREE = 0
    OCCUPIED = 1
    UNKNOWN = 2  # inside the bounds, never observed
    OUTSIDE = 3  # beyond the bounds


class FieldSample(NamedTuple):
    """The answer of a distance field at points p_WQ of shape (..., 3)."""

    # (...,) [m] to the nearest occupied surface, negative inside an obstacle. Where the state is
    # UNKNOWN it is the distance to the surfaces that were seen, an upper bound of the true one;
    # where it is OUTSIDE it is NaN, unless the field says otherwise.
    distance: np.ndarray
    gradient: np.ndarray  # (..., 3) [-] d distance / d p_WQ in W; zero where distance is NaN
    state: np.ndarray  # (...,) uint8, a `FieldState`


class Distances(Protocol):
    """Signed distances of points, and nothing else about them."""

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """The distance (...,) [m] at the points p_WQ (..., 3) [m]."""
        ...


class DistanceField(Protocol):
    """A signed distance field over the box [lower_W, upper_W] of the world."""

    @property
    def lower_W(self) -> np.ndarray:
        """(3,) [m], the corner of the box with the smallest coordinates."""
        ...

    @property
    def upper_W(self) -> np.ndarray:
        """(3,) [m], the corner of the box with the largest coordinates."""
        ...

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Distance, gradient and state at the points p_WQ (..., 3) [m]."""
        ...

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """The distance alone, (...,) [m], faster than `query`."""
        ...


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
