import numpy as np
import pytest

from splatpilot.analysis.fidelity.study import band, first_crossing, monotone_fit, reach


def test_fit_pools_violators():
    x, fit = monotone_fit([3, 0, 1, 2, 2, 2, 2], [4, 0, 3, -90, 1, 3, 90])
    np.testing.assert_allclose(x, [0, 1, 2, 3])
    # At 2 the median is 2 (four times the weight), below the 3 at 1: pooled to 11/5.
    np.testing.assert_allclose(fit, [0, 2.2, 2.2, 4])


def test_reach_is_where_the_fit_crosses():
    x = np.linspace(0, 2, 21)
    assert reach(x, 0.3 * x, 0.15) == pytest.approx(0.5)
    rng = np.random.default_rng(0)
    many = rng.uniform(0, 2, 4000)
    assert reach(many, 0.3 * many + rng.normal(0, 0.05, 4000), 0.15) == pytest.approx(0.5, abs=0.08)


def test_one_wrong_view_does_not_move_the_reach():
    x = np.repeat(np.linspace(0, 1, 11), 9)
    y = 0.3 * x
    y[:1] = 300.0
    assert reach(x, y, 0.15) == pytest.approx(0.5)


def test_bands():
    found = band(np.repeat([0.5, 0.0], 11), np.r_[np.arange(11), np.full(11, 7)])
    np.testing.assert_allclose(found.at, [0, 0.5])
    np.testing.assert_allclose([found.low, found.middle, found.high], [[7, 1], [7, 5], [7, 9]])
    many = band(np.arange(40), 2.0 * np.arange(40))
    np.testing.assert_array_equal(many.counts, [5] * 8)
    np.testing.assert_allclose(many.middle, 2 * many.at)
    assert len(band(np.arange(4000), np.arange(4000)).at) == 16


def test_reach_ends_where_nothing_was_measured():
    assert reach([0.0, 0.4, 0.8], [0, 0.1, 0.2], 1.0) == 0.8
    assert reach([0.1, 0.4, 0.8], [2, 2, 2], 1.0) == 0


def test_first_crossing():

    def values():
        yield from (0.0, 1.0, 0.0)
        raise RuntimeError("asked too far")

    assert first_crossing([0, 1, 2, 3], values(), 0.25) == 0.25
    assert first_crossing([0, 1, 2], [0.5, 0.0, 0.0], 0.25) == 0
    assert first_crossing([0, 1, 2], [0.0, 0.1, 0.2], 0.25) == 2
