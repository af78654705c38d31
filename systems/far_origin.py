"""Where the origin should be for single precision to resolve what is there."""

import numpy as np
from numpy.typing import NDArray

_FAR = 1000.0
"""Distance from 0, in meters and in times the extent, at which a float has steps of 6e-5."""


def choose_origin(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a new origin (3,) near positions (N, 3) that are far from 0, and 0 for others."""
    middle = np.median(positions, axis=0)
    distance = float(np.linalg.norm(middle))
    extent = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    if not distance > _FAR * (min(1.0, extent) or 1.0):
        return np.zeros(3)
    # Whole numbers are easily read, if they are near enough.
    return np.round(middle) if extent > 1 else middle
