"""Balls that move, and the distance fields they are part of."""

import numpy as np
import pytest

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.shapes import AnalyticDistanceField, MovingBalls, Sphere

LOWER, UPPER = np.full(3, -5.0), np.full(3, 5.0)
AWAY = np.full(3, np.inf)
PATHS = [
    np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]),
    np.array([[-3.0, 0, 0]]),
    np.array([[0.0, 3, 0], AWAY]),
]
BALLS = MovingBalls([0.5, 0.25, 1.0], PATHS, period=0.5)


def test_paths_are_followed_there_and_back():
    """Each ball stands on a row for a period, turns back at the last, and again at the first."""
    x = [BALLS.centers(0.5 * step)[0, 0] for step in range(9)]
    assert x == [0, 1, 2, 1, 0, 1, 2, 1, 0]
    np.testing.assert_array_equal(BALLS.centers(0.74), BALLS.centers(0.5))
    np.testing.assert_array_equal(BALLS.centers(7.3)[1], PATHS[1][0])
    assert np.isinf(BALLS.centers(0.5)[2]).all() and np.isfinite(BALLS.centers(1.0)[2]).all()


def test_steps_of_a_simulation_reach_their_rows():
    """Times that are sums of periods, however they were rounded, are on the row they end on."""
    steps = np.arange(1500)
    balls = MovingBalls([1.0], [np.column_stack([steps, steps, steps])], period=0.02)
    time = 0.0
    for step in steps:
        assert balls.centers(time)[0, 0] == step == balls.centers(0.02 * step)[0, 0]
        time += 0.02


@pytest.mark.parametrize("time", [0.0, 0.5, 1.2])
def test_the_field_is_that_of_everything_where_it_is(time):
    """Distances, gradients and states are those of one field of standing and placed balls."""
    standing = Sphere([0.0, -2.0, 1.0], 0.7)
    placed = [
        Sphere(center, radius)
        for center, radius in zip(BALLS.centers(time), BALLS.radii, strict=True)
        if np.isfinite(center).all()
    ]
    p_WQ = np.random.default_rng(0).uniform(-5.5, 5.5, (40, 5, 3))
    expected = AnalyticDistanceField([standing, *placed], LOWER, UPPER).query(p_WQ)
    field = BALLS.among(AnalyticDistanceField([standing], LOWER, UPPER), time)
    sample = field.query(p_WQ)
    np.testing.assert_allclose(sample.distance, expected.distance, atol=1e-12)
    np.testing.assert_allclose(sample.gradient, expected.gradient, atol=1e-12)
    np.testing.assert_array_equal(sample.state, expected.state)
    np.testing.assert_array_equal(field.distance(p_WQ), sample.distance)
    assert field.query(p_WQ[0, 0]).distance.shape == ()


def test_samples_of_trajectories_meet_the_balls_of_their_times():
    """Along trajectories the distance at each sample is that of the field at the sample's time."""
    field = AnalyticDistanceField([Sphere([0.0, -2.0, 1.0], 0.7)], LOWER, UPPER)
    times = np.array([0.2, 0.6, 1.1, 1.4])
    p_WQ = np.random.default_rng(1).uniform(-4.0, 4.0, (30, 4, 3))
    along = BALLS.along(field, times).distance(p_WQ)
    assert along.shape == (30, 4)
    for s, time in enumerate(times):
        expected = BALLS.among(field, time).distance(p_WQ[:, s])
        np.testing.assert_array_equal(along[:, s], expected)


def test_the_middle_of_a_ball_has_no_gradient():
    """At its centre, where no direction leads out fastest, the gradient is zero and not NaN."""
    sample = BALLS.among(AnalyticDistanceField([], LOWER, UPPER), 0.0).query(PATHS[1][0])
    assert sample.distance == -0.25 and sample.state == FieldState.OCCUPIED
    assert not sample.gradient.any()


def test_balls_without_a_path_are_refused():
    """Radii and paths that do not match, empty paths and sizes that are not positive are errors."""
    path = np.zeros((1, 3))
    for radii, paths, period, match in (
        ([1.0, 1.0], [path], 0.1, "2 radii and 1 paths"),
        ([1.0], [path[:0]], 0.1, "at least one row"),
        ([0.0], [path], 0.1, "must be positive"),
        ([1.0], [path], 0.0, "must be positive"),
    ):
        with pytest.raises(ValueError, match=match):
            MovingBalls(radii, paths, period)
