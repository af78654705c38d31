import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Sphere
from splatpilot.systems.messaging.flight_limits import (
    RETURN_SPEED,
    Motion,
    limit_ahead,
    limit_approach,
    stopping_displacement,
)
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


@pytest.mark.parametrize("speed", [0.0, 1.19, 6.0])
def test_stopping_displacement_is_the_integral_of_the_braking_velocity(speed):
    direction, response, deceleration, dt = np.array([0.6, 0.0, -0.8]), 0.4, 3.0, 1e-3
    v, moved = speed, 0.0
    while v > 1e-5:
        change = dt * min(v / response, deceleration)
        moved += dt * (v - 0.5 * change)
        v -= change
    stop = stopping_displacement(speed * direction, response, deceleration)
    np.testing.assert_allclose(stop, moved * direction, atol=1e-3)


@pytest.mark.parametrize("dead_time", [0.1, 0.42])
def test_a_point_that_obeys_late_approaches_without_overshoot(dead_time):
    dt, away, room = 0.002, np.array([-1.0, 0.0, 0.0]), 2.0
    late = [0.0] * round(dead_time / dt)
    for _ in range(3_000):
        desired = limit_approach(np.array([6.0, 0.0, 0.0]), away, room, np.e * dead_time)
        late.append(desired[0])
        room -= dt * late.pop(0)
        assert room > -1e-9


@pytest.mark.parametrize(
    ("velocity", "room", "limited"),
    [
        ([1.0, 2.0, -0.5], 1.0, [1.0, 2.0, -0.5]),
        ([3.0, 2.0, -20.0], 4.0, [3.0, 2.0, -4.0 / 0.5]),
        ([3.0, 2.0, -20.0], 0.01, [3.0, 2.0, -0.01 / 0.5]),
        ([0.0, 0.0, 9.0], 1.0, [0.0, 0.0, 9.0]),
        ([0.0, 0.0, 0.0], -0.1, [0.0, 0.0, 0.2]),
        ([0.0, 0.0, 0.0], -100.0, [0.0, 0.0, RETURN_SPEED]),
    ],
)
def test_only_fast_approaches_are_limited_and_the_return_is_slow(velocity, room, limited):
    away = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(limit_approach(np.array(velocity), away, room, 0.5), limited)


POST = Sphere([4.0, 0.0, 0.0], 0.5)
WALL = Box(RigidTransform([0.0, 2.0, 0.0]), [100.0, 2.0, 9.0])  # from y = 1 on
FIELD = AnalyticDistanceField([WALL, POST], np.full(3, -50.0), np.full(3, 50.0))
ROOM = 4.0 - 0.5 - VEHICLE_RADIUS - 0.1


@pytest.mark.parametrize(
    ("v", "p", "stop", "limited"),
    [
        (5.0, 0.0, 0.0, ROOM),  # The wall is nearer, but the post is ahead.
        (5.0, 0.0, 1.0, ROOM - 1.0),
        (-5.0, 0.0, 0.0, -5.0),
        (1.0, 0.0, 0.0, 1.0),
        (2.0, 0.0, 4.0, -(4.0 - ROOM)),  # It would rest in the post.
        (0.0, 0.0, 9.0, -RETURN_SPEED),
        (5.0, ROOM + 0.05, 0.0, 0.03),  # It is too near, and may leave.
        (-5.0, ROOM + 0.05, 0.0, -5.0),
    ],
)
def test_obstacles_ahead_limit_the_velocity(v, p, stop, limited):
    motion = Motion(np.array([p, 0.0, 0.0]), np.array([stop, 0.0, 0.0]), 1.0)
    result = limit_ahead(np.array([v, 0.0, 0.0]), motion, FIELD, VEHICLE_RADIUS, 0.1)
    np.testing.assert_allclose(result, [limited, 0.0, 0.0], atol=0.06)
    assert result[0] <= max(limited, 0.1)
