"""Interface of distance fields: signed distance, its gradient and the state of space."""

from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from splatpilot.systems.common.drake import float_values, is_autodiff
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.state import array_namespace


class FieldState(IntEnum):
    """State of a point of space; the numbers are part of the `esdf.npz` format."""

    FREE = 0
    OCCUPIED = 1
    UNKNOWN = 2  # inside the bounds, not observed
    OUTSIDE = 3  # beyond the bounds


class FieldSample(NamedTuple):
    """Values of a distance field at points p_WQ (..., 3), numpy arrays or torch tensors.

    Distances of AutoDiffXd points or tensors are differentiable.
    """

    # (...,) [m] to the nearest occupied surface, negative inside an obstacle. Where the state is
    # UNKNOWN it is the distance to observed surfaces, an upper bound of the true one; where it is
    # OUTSIDE it is NaN, unless the field says otherwise.
    distance: Any
    gradient: Any  # (..., 3) [-] d distance / d p_WQ in W; zero where distance is NaN
    state: Any  # (...,) uint8, a `FieldState`


class Distances(Protocol):
    """Signed distances of points."""

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Returns distances (...,) [m] at the points p_WQ (..., 3) [m]."""
        ...


class DistanceField(Distances, Protocol):
    """A signed distance field over the box [lower_W, upper_W], (3,) [m], of the world."""

    @property
    def lower_W(self) -> np.ndarray: ...

    @property
    def upper_W(self) -> np.ndarray: ...

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Returns distance, gradient and state at the points p_WQ (..., 3) [m]."""
        ...


def linearize(value: Any, gradient: Any, step: Any) -> Any:
    """Returns value (...,) + gradient (..., n) step (..., n); for a step of zeros that has
    derivatives, value with the derivatives of the chain rule."""
    return value + (gradient * step).sum(-1)


def sample_field(field: DistanceField, p_WQ: Any) -> FieldSample:
    """Queries any field at points (..., 3) [m], floats or AutoDiffXd; the gradient is floats."""
    if not is_autodiff(p_WQ):
        return field.query(p_WQ)
    points = float_values(p_WQ)
    sample = field.query(points)
    return sample._replace(distance=linearize(sample.distance, sample.gradient, p_WQ - points))


def soft_barrier(distance: Any, radius: Any, beta: Any = 4.0, margin: Any = 1.0) -> Any:
    """Computes a differentiable collision penalty [m], near zero in free space (equation 3).

        soft(d) = softplus(beta (radius + margin - d)) / beta

    The signed distance (...,) [m] is a numpy array, float or torch tensor; all arguments may have
    AutoDiffXd.
    """
    require(beta > 0.0, "beta", "> 0 1/m", beta)
    exponent = beta * (radius + margin - distance)
    if array_namespace(exponent) is not np:
        return exponent.logaddexp(exponent.new_zeros(())) / beta
    x = float_values(exponent)
    with np.errstate(invalid="ignore"):  # NaN in, NaN out, without a warning
        # A third of the time of `np.logaddexp`.
        softplus = np.maximum(x, 0.0) + np.log1p(np.exp(-np.abs(x)))
        if is_autodiff(exponent):
            softplus = softplus + np.exp(x - softplus) * (exponent - x)
    return softplus / beta


def in_collision(distance: Any, radius: float) -> Any:
    """Checks if a vehicle of this radius [m] collides at signed distances (...,) [m]; NaN: no."""
    return distance < radius
