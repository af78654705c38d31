"""Intervals and tests against published values."""

import numpy as np
import pytest

from splatpilot.analysis.benchmark.statistics import mcnemar, wilson_interval


@pytest.mark.parametrize(
    ("successes", "flights", "lower", "upper"),
    [
        # R. G. Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_interval_is_the_published_one(successes, flights, lower, upper):
    """The interval agrees with Newcombe's worked examples to the digits he gives."""
    interval = wilson_interval(successes, flights)
    assert interval.lower == pytest.approx(lower, abs=5e-5)
    assert interval.upper == pytest.approx(upper, abs=5e-5)


def test_interval_without_flights_is_everything():
    """Nothing flown says nothing."""
    assert wilson_interval(0, 0) == (0.0, 1.0)


def paired(only_first: int, only_second: int, both: int, neither: int):
    first = [True] * only_first + [False] * only_second + [True] * both + [False] * neither
    second = [False] * only_first + [True] * only_second + [True] * both + [False] * neither
    return np.array(first), np.array(second)


def test_mcnemar_is_the_binomial_of_unequal_pairs():
    """With 6 and 16 unequal pairs p is 2 P(X <= 6) of 22 fair coins, 0.0525, whatever the equal
    pairs; swapping the policies swaps the counts.
    """
    first, second = paired(6, 16, 80, 59)
    result = mcnemar(first, second)
    assert (result.only_first, result.only_second) == (6, 16)
    assert result.p_value == pytest.approx(2 * 110056 / 2**22)
    assert mcnemar(second, first) == (16, 6, result.p_value)
    assert mcnemar(*paired(6, 16, 0, 0)).p_value == result.p_value


def test_mcnemar_without_unequal_pairs():
    """Policies that always do alike do not differ."""
    assert mcnemar(*paired(0, 0, 5, 3)) == (0, 0, 1.0)
