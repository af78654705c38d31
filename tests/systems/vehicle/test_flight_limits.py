"""Velocities that can be braked in time."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.shapes import Box, Sphere
from splatpilot.systems.vehicle.flight_limits import (
    REACTION_TIME,
    FlightLimits,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS


@pytest.mark.parametrize("room", [0.01, 0.3, 1.0, 4.0])
def test_vehicle_stops_within_its_room(room):
    """At the greatest velocity that is left, reaction and braking take just the room; what leads
    along the obstacle is as wanted."""
    away, deceleration = np.array([0.6, 0.8, 0.0]), 5.0
    along = np.array([0.8, -0.6, 0.0])
    left = limit_approach(-20.0 * away + 3.0 * along, away, room, deceleration)
    v = -left.dot(away)
    assert v * REACTION_TIME + v**2 / (2 * deceleration) == pytest.approx(room)
    assert left.dot(along) == pytest.approx(3.0)


def test_what_can_be_braked_is_left_as_it_is():
    """Slow approaches, and flight away, pass; too near the vehicle is led away."""
    away = np.array([0.0, 0.0, 1.0])
    for v in ([1.0, 2.0, -0.5], [0.0, 0.0, 9.0]):
        np.testing.assert_array_equal(limit_approach(np.array(v), away, 1.0, 5.0), v)
    np.testing.assert_allclose(limit_approach(np.zeros(3), away, -0.12, 5.0), [0, 0, 0.2])


def test_box_is_not_left():
    """A body that obeys at once, whatever is wanted, stays in the box; from outside it returns."""
    lower, upper = np.array([0.0, -1, 0]), np.array([4.0, 1, 3])
    random = np.random.default_rng(0)
    p = np.array([2.0, 0.0, 1.0])
    for _ in range(2000):
        p = p + 0.02 * limit_to_box(random.normal(scale=20.0, size=3), p, lower, upper, 5.0)
        assert (p >= lower).all() and (p <= upper).all()
    p = np.array([5.0, 0.0, -1.0])
    for _ in range(400):
        p = p + 0.02 * limit_to_box(np.array([3.0, 0.0, -3.0]), p, lower, upper, 5.0)
    np.testing.assert_allclose(p, [4.0, 0.0, 0.0], atol=0.01)


def test_nothing_ahead_is_run_into_that_is_not_the_nearest():
    """Beside a wall the way along it is limited by the post ahead: to what can stop before it, not
    by the wall, which is nearer; where the way is free it is as wanted, and who is too near may
    leave."""
    wall = Box(RigidTransform([0.0, 2.0, 0.0]), [100.0, 2.0, 9.0])  # from y = 1 on
    post = Sphere([4.0, 0.0, 0.0], 0.5)
    field = AnalyticDistanceField([wall, post], np.full(3, -50.0), np.full(3, 50.0))
    limits, v = FlightLimits(), np.array([5.0, 0.0, 0.0])
    room = 4.0 - 0.5 - VEHICLE_RADIUS - limits.min_clearance
    left = limit_ahead(v, np.zeros(3), field, limits)[0]
    reach = left * REACTION_TIME + left**2 / (2 * limits.deceleration)
    assert reach == pytest.approx(room, abs=0.11)
    np.testing.assert_array_equal(limit_ahead(-v, np.zeros(3), field, limits), -v)
    slow = np.array([1.0, 0.0, 0.0])
    np.testing.assert_array_equal(limit_ahead(slow, np.zeros(3), field, limits), slow)
    near = np.array([4.0 - 0.5 - VEHICLE_RADIUS - 0.05, 0.0, 0.0])
    assert 0.0 <= limit_ahead(v, near, field, limits)[0] < 0.2
    np.testing.assert_array_equal(limit_ahead(-v, near, field, limits), -v)


def test_speed_is_shortened():
    """Velocities keep their direction."""
    np.testing.assert_allclose(limit_speed(np.array([6.0, 0, 8]), 5.0), [3, 0, 4])
    np.testing.assert_array_equal(limit_speed(np.zeros(3), 5.0), np.zeros(3))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_speed", 0.0),
        ("max_tilt", 2.0),
        ("deceleration", np.nan),
        ("min_clearance", -0.1),
        ("geofence", [[0.0, 0, 0], [1.0, 1, 0]]),
        ("geofence", [[0.0, 0, 0]]),
    ],
)
def test_bad_limits_are_named(field, value):
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=rf"limits\.{field} is"):
        FlightLimits(**{field: value}).validate()
