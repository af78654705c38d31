"""Velocities that a failsafe tells a vehicle to fly."""

import itertools
import math

import numpy as np
import pytest
from failsafe_bench import LAW, Bench
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Cylinder
from splatpilot.systems.messaging import flight_limits
from splatpilot.systems.messaging.failsafe import FailsafeConfig, Modes, limited_setpoint
from splatpilot.systems.messaging.flight_limits import (
    RETURN_SPEED,
    FlightLimits,
    Motion,
    Surroundings,
    stopping_displacement,
)
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

WIDE = np.full(3, -60.0), np.full(3, 60.0)
WALL = AnalyticDistanceField([Box(RigidTransform([0.5, 0, 0]), np.array([1.0, 90, 90]))], *WIDE)
POST = AnalyticDistanceField([Cylinder(p_WA=[0.5, 0, -50], p_WB=[0.5, 0, 50], radius=0.5)], *WIDE)

vectors = st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3).map(np.array)


@given(
    p_WB=vectors,
    v_WB=vectors,
    desired=vectors,
    held=vectors,
    gradient=vectors,
    clearance=st.floats(-1e4, 1e4) | st.just(math.nan),
    age=st.floats(-0.2, 0.3),
    max_speed=st.floats(0.1, 6.0),
    mode=st.sampled_from([status.FLYING, status.HOLDING, status.LANDING]),
    known=st.booleans(),
    field=st.sampled_from([None, POST]),
)
def test_no_state_and_no_map_is_flown_faster_than_the_limit(
    p_WB, v_WB, desired, held, gradient, clearance, age, max_speed, mode, known, field
):
    limits = FlightLimits(max_speed=max_speed)
    motion = Motion.predict(p_WB, v_WB, age, 0.1, limits.deceleration, LAW) if known else None
    modes = Modes(mode, status.NONE, p_WH=held)
    near = Surroundings(clearance, gradient, flight_limits.Box(-np.ones(3), np.ones(3)), field)
    config = FailsafeConfig(limits=limits)
    setpoint, _ = limited_setpoint(mode, np.append(desired, 0.0), motion, modes, near, config)
    most = max_speed if mode == status.FLYING else min(max_speed, RETURN_SPEED)
    assert np.linalg.norm(setpoint[:3]) <= most * (1 + 1e-9)


def test_from_outside_the_fence_the_vehicle_returns_slowly():
    bench = Bench(p_WB=(25.0, 0.0, 3.0))
    speeds = []
    for _ in range(200):
        bench.advance(0.02)
        speeds.append(np.linalg.norm(bench.state[3:6]))
    assert 0.9 * RETURN_SPEED < max(speeds) < 1.05 * RETURN_SPEED


def fenced(**corners: float) -> tuple[np.ndarray, np.ndarray]:
    """A wide box whose faces are moved: `x1` is that at the greater x, `z0` the floor."""
    box = np.array(WIDE)
    for face, value in corners.items():
        box[int(face[1]), "xyz".index(face[0])] = value
    return box[0], box[1]


AHEAD = {
    "wall": (WALL, WIDE, [1.0, 0.0, 0.0]),
    "post": (POST, WIDE, [1.0, 0.0, 0.0]),
    "fence": (None, fenced(x1=0.0), [1.0, 0.0, 0.0]),
    "floor": (None, fenced(z0=0.0), [0.0, 0.0, -1.0]),
    "ceiling": (None, fenced(z1=0.0), [0.0, 0.0, 1.0]),
}


def room_left(bench: Bench, box) -> float:
    """The distance [m] by which limits are kept: min_clearance, and the sphere in the box."""
    p_WB = bench.state[:3]
    inside = float(np.min([p_WB - box[0], box[1] - p_WB])) - VEHICLE_RADIUS
    if bench.field is None:
        return inside
    return min(inside, float(bench.field.distance(p_WB)) - VEHICLE_RADIUS - 0.1)


HEAD_ON = [
    *itertools.product(["wall", "post"], ["velocity", "body_rates"], [0.1], [1.0, 6.0]),
    *itertools.product(["wall", "fence", "floor", "ceiling"], ["velocity"], [0.3], [3.0, 6.0]),
    *itertools.product(["fence", "floor", "ceiling"], ["body_rates"], [0.1], [1.0, 6.0]),
    *itertools.product(["post", "floor"], ["body_rates"], [0.0], [3.0]),
]


@pytest.mark.parametrize(("what", "by", "age", "speed"), HEAD_ON)
def test_limits_are_kept_head_on_at_any_speed_and_age(what, by, age, speed):
    field, box, direction = AHEAD[what]
    v_WB = speed * np.array(direction)
    limits = FlightLimits()
    motion = Motion.predict(np.zeros(3), v_WB, age, 0.0, limits.deceleration, LAW)
    away = VEHICLE_RADIUS + 0.1 + np.linalg.norm(motion.stop) + motion.reaction_time * speed
    p_WB = -(away + 0.2) * np.array(direction)
    bench = Bench(None, p_WB, v_WB, age, by, box, field)
    closest = math.inf
    for _ in range(120):
        bench.advance(0.02, want=v_WB)
        closest = min(closest, room_left(bench, box))
        assert bench.out("mode")[0] == status.FLYING
    assert closest >= -1e-3
    assert bench.out("mode")[1] in (status.LIMITED_CLEARANCE, status.LIMITED_GEOFENCE)


@pytest.mark.parametrize("moment", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("what", ["post", "fence"])
def test_limits_are_kept_if_the_policy_is_lost_on_the_way(what, moment):
    field, box, direction = AHEAD[what]
    v_WB = 4.0 * np.array(direction)
    bench = Bench(None, -5.0 * np.array(direction), v_WB, 0.02, "body_rates", box, field)
    bench.advance(moment, want=v_WB)
    bench.give(observation_age=1.0)
    closest = math.inf
    for _ in range(100):
        bench.advance(0.02)
        closest = min(closest, room_left(bench, box))
    assert closest >= -1e-3
    assert np.linalg.norm(bench.state[3:6]) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_limits_are_kept_whatever_accelerations_are_commanded(seed):
    random = np.random.default_rng(seed)
    bench = Bench(None, (-3.0, 0.0, 0.0), (0.01, 0.0, 0.0), 0.02, "body_rates", WIDE, POST)
    for _ in range(20):
        a_WB = random.uniform(-8.0, 8.0, 3) * [1, 1, 0.2] - 0.5 * bench.state[:3]
        for _ in range(10):
            bench.accelerate(a_WB)
            bench.advance(0.02)
            assert room_left(bench, WIDE) >= -1e-2


def test_what_is_free_is_flown_as_fast_as_desired():
    bench = Bench(None, (-30.0, 0.0, 0.0), (6.0, 0.0, 0.0), 0.02, "body_rates", WIDE, POST)
    reach = float(np.linalg.norm(stopping_displacement(np.array([6.0, 0, 0]), 0.4, 5.0)))
    while bench.state[0] < -(reach + 6.0 * math.e * 0.16 + 1.0):
        bench.advance(0.02, want=[6.0, 0.0, 0.0])
        assert bench.out("mode")[1] in (status.NONE, status.LIMITED_SPEED)


def test_a_policy_that_wants_to_fly_too_fast_flies_as_fast_as_allowed():
    config = FailsafeConfig(limits=FlightLimits(max_speed=4.0))
    bench = Bench(config, (-40.0, 0.0, 0.0), (1e-3, 0.0, 0.0), 0.02, "body_rates", WIDE)
    for _ in range(100):
        bench.advance(0.02, want=[9.0, 0.0, 0.0])
        assert bench.state[3] < 1.05 * 4.0
    assert bench.state[3] > 3.9
    np.testing.assert_array_equal(bench.out("mode"), [status.FLYING, status.LIMITED_SPEED])
