"""What every distance field answers: signed distance, its gradient and what is known there."""

from enum import IntEnum
from typing import NamedTuple, Protocol

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
