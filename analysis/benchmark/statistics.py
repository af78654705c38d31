"""
How far successes of a finite number of flights can be trusted.

Two questions have two answers. Wilson's interval and McNemar's test take flights as independent:
they hold for these scenarios with new seeds. Flights of one scenario share what makes it hard, so
the cluster bootstrap and the sign-flip test take scenarios as independent: they hold for new
scenarios of the same kinds.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest

_RESAMPLES = 9999
_EXACT = 17
"""Up to so many scenarios all 2^n signs are tried, of more scenarios as many random ones."""


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


def cluster_interval(
    successes: ArrayLike, flights: ArrayLike, confidence: float = 0.95
) -> Interval:
    """
    Returns the percentile interval of a success rate by a bootstrap over scenarios.

    Fewer than two scenarios say nothing about others. If all have the same rate, resampling shows
    no spread, and the interval is Wilson's with each scenario counted as one flight.

    Args:
        successes, flights: of each scenario, (S,).
    """
    k, n = np.asarray(successes, float), np.asarray(flights, float)
    if len(k) < 2:
        return Interval(0.0, 1.0)
    if np.ptp(k / n) == 0:
        return wilson_interval(round(float(k.sum() / n.sum()) * len(k)), len(k), confidence)
    drawn = np.random.default_rng(0).integers(len(k), size=(_RESAMPLES, len(k)))
    rates = k[drawn].sum(axis=1) / n[drawn].sum(axis=1)
    lower, upper = np.quantile(rates, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(lower), float(upper))


class PairedCounts(NamedTuple):
    """Two policies on the same flights."""

    only_first: int
    """Flights in which only the first succeeded."""
    only_second: int
    """Flights in which only the second did."""
    p_value: float
    """Probability of a difference as large if the policies were equally good."""


def mcnemar(first: np.ndarray, second: np.ndarray) -> PairedCounts:
    """The exact test of McNemar (Psychometrika 12, 1947) on paired successes (n,) bool.

    Where both policies succeed or both fail says nothing; of the other flights each would be won by
    either with probability one half, so that the count of one is binomial.
    """
    only_first = int(np.count_nonzero(first & ~second))
    only_second = int(np.count_nonzero(second & ~first))
    unequal = only_first + only_second
    p_value = float(binomtest(only_first, unequal).pvalue) if unequal else 1.0
    return PairedCounts(only_first, only_second, p_value)


def sign_flip(differences: ArrayLike) -> float:
    """
    Returns the two-sided p-value of a paired sign-flip permutation test over scenarios.

    If the policies were equally good in scenarios of these kinds, the difference of their success
    rates in a scenario would have either sign with probability one half.

    Args:
        differences: of the success rates of two policies in each scenario, (S,).
    """
    d = np.asarray(differences, float)
    d = d[d != 0]
    if len(d) <= _EXACT:
        bits = np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1
    else:
        bits = np.random.default_rng(0).integers(2, size=(2**_EXACT, len(d)))
        bits[0] = 0  # what was observed is one of the possibilities
    sums = np.abs((1 - 2 * bits) @ d)
    return float(np.mean(sums >= abs(d.sum()) - 1e-12))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Returns p-values (m,) corrected for the number of tests (S. Holm, Scand. J. Statistics 6,
    1979): the chance of any false positive among them stays below the level."""
    p = np.asarray(p_values, float)
    order = np.argsort(p)
    steps = (len(p) - np.arange(len(p))) * p[order]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
