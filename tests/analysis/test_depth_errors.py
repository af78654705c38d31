import numpy as np
import pytest

from splatpilot.analysis.depth_errors import DepthErrors, DepthFrame, at_edges, depth_errors

REACH = 20.0


def test_each_error_is_counted_as_what_it_is():
    """Of 100 pixels at 2 m, all read 1 % too far, some are moved by known amounts: each measure is
    the share of its own, and what nobody knows is left out of all."""
    truth = np.full(120, 2.0)
    truth[100:] = np.nan
    depth = 1.01 * truth
    depth[100:] = 0.3
    depth[:10] = 1.8  # too near
    depth[10:13] = 0.0  # nearer than the camera sees
    depth[15:18] = 2.3  # too far
    depth[18:20] = np.inf  # a hole
    errors = DepthErrors.of(depth, truth, REACH)
    assert errors.pixels == 100 and errors.left_out == pytest.approx(20 / 120)
    assert errors.bias == pytest.approx(0.01)
    assert errors.p5 == pytest.approx(-0.1) and errors.p95 == pytest.approx(0.01)
    shares = errors.too_near, errors.far_too_near, errors.too_far, errors.holes
    assert shares == pytest.approx((0.13, 0.03, 0.05, 0.02))


def test_what_is_beyond_reach_is_infinite_for_both():
    """Nothing is wrong with infinity before the sky or just within reach; a surface before the sky
    is too near, and infinity before a wall is a hole."""
    truth = np.array([np.inf, 25.0, 19.9, np.inf, 10.0])
    depth = np.array([np.inf, np.inf, np.inf, 15.0, np.inf])
    errors = DepthErrors.of(depth, truth, REACH)
    assert (errors.too_near, errors.too_far, errors.holes) == (0.2, 0.2, 0.2)
    assert np.isnan(errors.bias)  # none of them is near


def test_slanted_planes_have_no_edges_and_steps_have():
    """Only the pixels within two of where a step's second difference is seen are at its edge, and
    their errors are told from the others'."""
    slope = np.linspace(0.05, 1.0, 40)  # inverse depth, linear as on a plane
    plane = np.tile(1 / slope, (30, 1))
    assert not at_edges(plane, 50.0).any()
    step = np.where(np.arange(40) < 20, 2.0, 3.0) * np.ones((30, 1))
    columns = np.flatnonzero(at_edges(step, REACH)[15])
    np.testing.assert_array_equal(columns, np.arange(17, 23))
    smeared = step.copy()
    smeared[:, 20] = 2.0
    found = depth_errors([DepthFrame(smeared, step)], REACH)
    assert found["all"].too_near == pytest.approx(1 / 40)
    assert found["at edges"].too_near == pytest.approx(1 / 6)
    assert found["elsewhere"].too_near == 0
