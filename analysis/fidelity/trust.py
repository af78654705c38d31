"""From measured errors to how far they can be trusted: monotone fits and where they cross limits.

Errors grow with what drives them (distance from the capture, or the share of a view nobody saw), up
to noise, and single views that show what nobody saw are wrong by any amount. So medians over views
are fitted by the non-decreasing function of least squares, and the reach is where that function
exceeds its limit: one half of the views keep it there.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import isotonic_regression

_MOST_GROUPS = 16
_PER_GROUP = 5  # samples at least, where x takes more values than there may be groups


@dataclass(frozen=True)
class Band:
    """Groups of samples of like x, in rising order: their mean x, their number, and the 10th, 50th
    and 90th percentile of y."""

    at: NDArray[np.float64]
    counts: NDArray[np.int64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]


def band(x: ArrayLike, y: ArrayLike) -> Band:
    """Groups samples by x: one group for each value if there are at most 16, otherwise up to 16
    groups of as many samples, at least 5 each."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    values, which = np.unique(np.round(x, 6), return_inverse=True)
    if len(values) <= _MOST_GROUPS:
        groups = [np.flatnonzero(which == k) for k in range(len(values))]
    else:
        count = min(_MOST_GROUPS, max(1, len(x) // _PER_GROUP))
        groups = np.array_split(np.argsort(x, kind="stable"), count)
    low, middle, high = np.array([np.percentile(y[group], [10, 50, 90]) for group in groups]).T
    at = np.array([x[group].mean() for group in groups])
    return Band(at, np.array([len(group) for group in groups]), low, middle, high)


def monotone_fit(x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean x of the groups of `band`, and there the non-decreasing function that is closest
    to the medians of y in the least-squares sense (pool adjacent violators)."""
    found = band(x, y)
    return found.at, isotonic_regression(found.middle, weights=found.counts).x


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
