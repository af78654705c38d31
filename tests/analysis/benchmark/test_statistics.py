"""Intervals and tests against published values."""

import numpy as np
import pytest
from scipy.stats import norm

from splatpilot.analysis.benchmark.tables import (
    cluster_interval,
    holm,
    mcnemar,
    sign_flip,
    wilson_interval,
)


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
    interval = wilson_interval(successes, flights)
    assert interval.lower == pytest.approx(lower, abs=5e-5)
    assert interval.upper == pytest.approx(upper, abs=5e-5)


def test_interval_without_flights_is_everything():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def paired(only_first: int, only_second: int, both: int, neither: int):
    first = [True] * only_first + [False] * only_second + [True] * both + [False] * neither
    second = [False] * only_first + [True] * only_second + [True] * both + [False] * neither
    return np.array(first), np.array(second)


def test_mcnemar_is_the_binomial_of_unequal_pairs():
    first, second = paired(6, 16, 80, 59)
    result = mcnemar(first, second)
    assert (result.only_first, result.only_second) == (6, 16)
    assert result.p_value == pytest.approx(2 * 110056 / 2**22)
    assert mcnemar(second, first) == (16, 6, result.p_value)
    assert mcnemar(*paired(6, 16, 0, 0)).p_value == result.p_value


def test_mcnemar_without_unequal_pairs():
    assert mcnemar(*paired(0, 0, 5, 3)) == (0, 0, 1.0)


def test_cluster_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        rates = rng.beta(2.0, 1.0, size=30)  # of scenarios; the mean is 2/3
        interval = cluster_interval(rng.binomial(10, rates), np.full(30, 10))
        covered += interval.lower <= 2 / 3 <= interval.upper
    assert 0.9 * 200 <= covered <= 0.99 * 200


def test_cluster_interval_without_correlation_is_that_of_flights():
    successes = np.random.default_rng(0).binomial(20, 0.5, size=100)
    clusters = cluster_interval(successes, np.full(100, 20))
    flights = wilson_interval(int(successes.sum()), 2000)
    np.testing.assert_allclose(clusters, flights, atol=0.006)


@pytest.mark.parametrize(
    ("successes", "flights", "expected"),
    [
        ([], [], (0.0, 1.0)),
        ([20], [20], (0.0, 1.0)),
        ([20, 20, 20], [20, 20, 20], wilson_interval(3, 3)),
        ([0, 0], [5, 5], wilson_interval(0, 2)),
    ],
)
def test_cluster_interval_of_equal_or_single_scenarios_is_wide(successes, flights, expected):
    assert cluster_interval(successes, flights) == expected


@pytest.mark.parametrize(
    ("differences", "p_value"),
    [
        ([], 1.0),
        ([0.0, 0.0], 1.0),
        ([0.5], 1.0),
        ([0.5, 0.5, 0.5, 0.5], 2 / 16),
        ([0.5, 0.5, 0.5, -0.5], 10 / 16),
        ([0.1, 0.2, 0.3, 0.0], 2 / 8),
    ],
)
def test_sign_flip_counts_the_signs_of_the_scenarios(differences, p_value):
    assert sign_flip(differences) == p_value


def test_sign_flip_of_many_scenarios_agrees_with_the_normal_distribution():
    differences = np.random.default_rng(1).normal(0.3, 1.0, size=60)
    z = differences.sum() / np.sqrt((differences**2).sum())
    assert sign_flip(differences) == pytest.approx(2 * norm.sf(abs(z)), rel=0.1)


def test_holm_is_the_published_one():
    # S. Holm's step-down by hand: 4 x 0.01, 3 x 0.02, 2 x 0.03 and 0.04, never falling.
    np.testing.assert_allclose(holm([0.04, 0.01, 0.03, 0.02]), [0.06, 0.04, 0.06, 0.06])
    np.testing.assert_allclose(holm([0.9, 0.5]), [1.0, 1.0])
    assert holm([]).shape == (0,)
