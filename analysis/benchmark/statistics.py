"""How far successes of a finite number of flights can be trusted."""

from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest


class Interval(NamedTuple):
    """A confidence interval."""

    lower: float
    upper: float


def wilson_interval(successes: int, flights: int, confidence: float = 0.95) -> Interval:
    """The score interval of a success rate (E. B. Wilson, 1927), all of [0, 1] without flights."""
    if flights == 0:
        return Interval(0.0, 1.0)
    interval = binomtest(successes, flights).proportion_ci(confidence, method="wilson")
    return Interval(float(interval.low), float(interval.high))


class PairedComparison(NamedTuple):
    """Two policies on the same flights."""

    only_first: int
    """Flights in which only the first succeeded."""
    only_second: int
    """Flights in which only the second did."""
    p_value: float
    """Probability of a difference as large if the policies were equally good."""


def mcnemar(first: np.ndarray, second: np.ndarray) -> PairedComparison:
    """The exact test of McNemar (Psychometrika 12, 1947) on paired successes (n,) bool.

    Where both policies succeed or both fail says nothing; of the other flights each would be won by
    either with probability one half, so that the count of one is binomial.
    """
    only_first = int(np.count_nonzero(first & ~second))
    only_second = int(np.count_nonzero(second & ~first))
    unequal = only_first + only_second
    p_value = float(binomtest(only_first, unequal).pvalue) if unequal else 1.0
    return PairedComparison(only_first, only_second, p_value)
