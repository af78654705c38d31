"""From measured errors to how far they can be trusted: monotone fits and where they cross limits.

Errors grow with what drives them (distance from the capture, or the share of a view nobody saw), up
to noise. So each error is fitted by the non-decreasing function of least squares, and the reach is
where that function exceeds its limit.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import isotonic_regression


def monotone_fit(x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the distinct values of x in rising order, and there the non-decreasing function that
    is closest to y in the least-squares sense (pool adjacent violators)."""
    distinct, inverse, counts = np.unique(
        np.asarray(x, np.float64), return_inverse=True, return_counts=True
    )
    means = np.bincount(inverse, np.asarray(y, np.float64)) / counts
    return distinct, isotonic_regression(means, weights=counts).x


def reach(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Returns the largest x up to which the monotone fit of y stays within `limit`.

    Between samples the fit is taken as linear. If it never exceeds the limit, the largest x that
    was measured is returned: nothing is known beyond. If it does from the start, 0.
    """
    at, fit = monotone_fit(x, y)
    beyond = np.flatnonzero(fit > limit)
    if not len(beyond):
        return float(at[-1])
    first = beyond[0]
    if first == 0:
        return 0.0
    (x0, x1), (y0, y1) = at[first - 1 : first + 1], fit[first - 1 : first + 1]
    return float(x0 + (x1 - x0) * (limit - y0) / (y1 - y0))


def first_crossing(x: ArrayLike, y: Iterable[float], limit: float) -> float:
    """Returns how far along the rising x the values y stay at most `limit`, linear in between; 0 if
    the first does not. No more values are asked for than it takes."""
    x = np.asarray(x, np.float64)
    before = 0.0
    for k, value in enumerate(y):
        if value > limit:
            return (
                float(x[k - 1] + (x[k] - x[k - 1]) * (limit - before) / (value - before))
                if k
                else 0.0
            )
        before = value
    return float(x[-1])
