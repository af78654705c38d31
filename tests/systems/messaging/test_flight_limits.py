"""Velocities that can be braked in time."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Sphere
from splatpilot.systems.messaging.flight_limits import (
    RETURN_SPEED,
    FlightLimits,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
    stopping_displacement,
)
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


@pytest.mark.parametrize("speed", [0.5, 1.19, 2.0, 6.0])
def test_stopping_displacement_is_the_integral_of_the_braking_velocity(speed):
    direction, response, deceleration, dt = np.array([0.6, 0.0, -0.8]), 0.4, 3.0, 1e-4
    v, moved = speed, 0.0
    while v > 1e-6:
        moved += dt * v
        v -= dt * min(v / response, deceleration)
    stop = stopping_displacement(speed * direction, response, deceleration)
    np.testing.assert_allclose(stop, moved * direction, atol=1e-3)


def test_a_vehicle_at_rest_stops_where_it_is():
    np.testing.assert_array_equal(stopping_displacement(np.zeros(3), 0.4, 3.0), np.zeros(3))


@pytest.mark.parametrize("room", [0.01, 0.3, 1.0, 4.0])
def test_an_approach_takes_the_reaction_time_and_what_leads_along_is_kept(room):
    away, along = np.array([0.6, 0.8, 0.0]), np.array([0.8, -0.6, 0.0])
    left = limit_approach(-20.0 * away + 3.0 * along, away, room, 0.5)
    assert -left.dot(away) * 0.5 == pytest.approx(room)
    assert left.dot(along) == pytest.approx(3.0)


@pytest.mark.parametrize("dead_time", [0.1, 0.42])
def test_a_point_that_obeys_late_approaches_without_overshoot(dead_time):
    dt, away, room = 0.002, np.array([-1.0, 0.0, 0.0]), 2.0
    late = [0.0] * round(dead_time / dt)
    for _ in range(10_000):
        wanted = limit_approach(np.array([6.0, 0.0, 0.0]), away, room, np.e * dead_time)
        late.append(wanted[0])
        room -= dt * late.pop(0)
        assert room > -1e-9


def test_slow_approaches_and_flight_away_are_kept_and_the_return_is_slow():
    away = np.array([0.0, 0.0, 1.0])
    for v in ([1.0, 2.0, -0.5], [0.0, 0.0, 9.0]):
        np.testing.assert_array_equal(limit_approach(np.array(v), away, 1.0, 0.5), v)
    np.testing.assert_allclose(limit_approach(np.zeros(3), away, -0.1, 0.5), [0, 0, 0.2])
    back = limit_approach(np.zeros(3), away, -100.0, 0.5)
    np.testing.assert_allclose(back, [0, 0, RETURN_SPEED])


def test_box_is_not_left():
    lower, upper = np.array([0.0, -1, 0]), np.array([4.0, 1, 3])
    random = np.random.default_rng(0)
    p = np.array([2.0, 0.0, 1.0])
    for _ in range(2000):
        p = p + 0.02 * limit_to_box(random.normal(scale=20.0, size=3), p, lower, upper, 0.3)
        assert (p >= lower).all() and (p <= upper).all()
    p = np.array([5.0, 0.0, -1.0])
    for _ in range(400):
        p = p + 0.02 * limit_to_box(np.array([3.0, 0.0, -3.0]), p, lower, upper, 0.3)
    np.testing.assert_allclose(p, [4.0, 0.0, 0.0], atol=0.01)


POST = Sphere([4.0, 0.0, 0.0], 0.5)
WALL = Box(RigidTransform([0.0, 2.0, 0.0]), [100.0, 2.0, 9.0])  # from y = 1 on
FIELD = AnalyticDistanceField([WALL, POST], np.full(3, -50.0), np.full(3, 50.0))
ROOM = 4.0 - 0.5 - VEHICLE_RADIUS - 0.1


def ahead(v, p=(0.0, 0.0, 0.0), stop=(0.0, 0.0, 0.0)) -> np.ndarray:
    return limit_ahead(np.array(v), np.array(p), np.array(stop), FIELD, 0.1, 1.0)


def test_what_lies_ahead_limits_though_something_else_is_nearer():
    assert ahead([5.0, 0.0, 0.0])[0] == pytest.approx(ROOM, abs=0.06)
    assert ahead([5.0, 0.0, 0.0])[0] < ROOM
    assert ahead([5.0, 0.0, 0.0], stop=[1.0, 0.0, 0.0])[0] == pytest.approx(ROOM - 1.0, abs=0.06)
    for free in ([-5.0, 0.0, 0.0], [1.0, 0.0, 0.0]):
        np.testing.assert_array_equal(ahead(free), free)


def test_a_vehicle_that_would_rest_in_an_obstacle_is_told_to_go_back():
    left = ahead([2.0, 0.0, 0.0], stop=[4.0, 0.0, 0.0])
    assert left[0] == pytest.approx(-(4.0 - ROOM), abs=0.06)
    assert ahead([0.0, 0.0, 0.0], stop=[9.0, 0.0, 0.0])[0] == -RETURN_SPEED


def test_a_vehicle_that_is_too_near_may_leave():
    near = [ROOM + 0.05, 0.0, 0.0]
    assert 0.0 <= ahead([5.0, 0.0, 0.0], p=near)[0] < 0.1
    np.testing.assert_array_equal(ahead([-5.0, 0.0, 0.0], p=near), [-5.0, 0.0, 0.0])


def test_speed_is_shortened():
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
        ("geofence", [[0.0, -5.0, 0.5], [10.0, 5.0, 1.1]]),
        ("geofence", [[0.0, 0.0, np.nan], [10.0, 5.0, 3.0]]),
    ],
)
def test_bad_limits_are_named(field, value):
    with pytest.raises(ValueError, match=rf"{field} must be .*, got"):
        FlightLimits(**{field: value}).validate()


def test_a_geofence_may_be_as_narrow_as_the_vehicle_and_its_margins():
    side = 2.0 * (VEHICLE_RADIUS + 0.1) + 1e-9
    FlightLimits(geofence=[[0.0, 0.0, 0.0], [side, side, side]]).validate()
