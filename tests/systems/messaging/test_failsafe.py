import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from harness import Harness
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Cylinder
from splatpilot.systems.messaging import flight_limits
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig, FiniteVector, Modes
from splatpilot.systems.messaging.flight_limits import (
    RETURN_SPEED,
    FlightLimits,
    Motion,
    Surroundings,
    stopping_displacement,
)
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity import RESPONSE_TIME, tracking_acceleration
from splatpilot.systems.vehicle import quadrotor
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, flatness_command
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.systems.vehicle.state import predict_state

LOWER, UPPER = np.array([0.0, -5.0, 0.0]), np.array([20.0, 5.0, 6.0])
HOVER = np.array([quadrotor.GRAVITY, 0.0, 0.0, 0.0])
LAW, VEHICLE = FlatnessControllerConfig(), quadrotor.QuadrotorParams()
PERIOD = LAW.period


class Bench(Harness):
    """A failsafe and a vehicle that it flies by velocities or by body rates, in steps of 20 ms.

    The test gives inputs; the state, which is `age` [s] old, comes by itself, unless the test gives
    one.
    """

    def __init__(
        self,
        config: FailsafeConfig | None = None,
        p_WB=(10.0, 0.0, 3.0),
        v_WB=(1e-3, 0.0, 0.0),  # At exact rest a state would not change, and seem frozen.
        age: float = 0.0,
        by: str = "body_rates",
        box=(LOWER, UPPER),
        field: DistanceField | None = None,
        radius: float = VEHICLE.radius,
    ):
        vehicle, self.radius = replace(VEHICLE, radius=radius), radius
        super().__init__(Failsafe(config or FailsafeConfig(), LAW, vehicle, *box, field))
        self.age, self.by, self.box, self.field = age, by, box, field
        self.state = hover_state(p_WB)
        self.state[3:6] = v_WB
        moved = np.append(PERIOD * self.state[3:6], np.zeros(10))
        self.states = [self.state - k * moved for k in range(round(age / PERIOD), -1, -1)]
        self.tick, self.min_room = 0, math.inf
        self.give(velocity_setpoint=[0.0, 0.0, 0.0, 0.5], command=HOVER)
        self.give_state()

    def give_state(self, measured: np.ndarray | None = None) -> None:
        """Gives the failsafe a state, that of the vehicle by default."""
        if measured is None:
            measured = self.states[-1 - round(self.age / PERIOD)]
        state = predict_state(measured, self.age)
        self.give(state=state, measured_state=measured, state_age=self.age)
        if self.field is not None:
            sample = self.field.query(state[:3])
            self.give(clearance=sample.distance - self.radius, gradient=sample.gradient)

    def accelerate(self, a_WB, v_WB=None) -> None:
        """Gives setpoint and command of a policy that desires an acceleration."""
        state = np.asarray(self.system.GetInputPort("state").Eval(self.context))
        command = flatness_command(state, a_WB, state[3:6], math.nan, LAW, VEHICLE)
        setpoint = state[3:6] + RESPONSE_TIME * a_WB if v_WB is None else v_WB
        self.give(velocity_setpoint=[*setpoint, math.nan], command=command)

    def advance(self, duration: float, measured=None, desired=None) -> None:
        """Flies on; `measured` is the state that the failsafe gets at a time, by default the
        vehicle's; `desired` is the velocity of the policy."""
        for _ in range(round(duration / PERIOD)):
            now = self.tick * PERIOD
            self.give_state(None if measured is None else measured(now))
            if desired is not None:
                state = np.asarray(self.system.GetInputPort("state").Eval(self.context))
                self.accelerate(tracking_acceleration(state[3:6], np.asarray(desired)), desired)
            self.simulator.AdvanceTo(now + 1e-6)
            command = self.out("command")
            if self.by == "velocity":
                setpoint = self.out("velocity_setpoint")
                acceleration = tracking_acceleration(self.state[3:6], setpoint[:3])
                command = flatness_command(
                    self.state, acceleration, np.zeros(3), setpoint[3], LAW, VEHICLE
                )
            self.state = quadrotor.rk4_step(self.state, command, VEHICLE, PERIOD)
            self.states.append(self.state)
            self.min_room = min(self.min_room, self._room())
            self.tick += 1

    def _room(self) -> float:
        """The distance [m] by which limits are kept: min_clearance, and the sphere in the box."""
        p_WB, (lower, upper) = self.state[:3], self.box
        room = float(np.min([p_WB - lower, upper - p_WB])) - self.radius
        if self.field is not None:
            room = min(room, float(self.field.distance(p_WB)) - self.radius - 0.1)
        return room

    def mode(self) -> tuple[float, float]:
        return tuple(self.out("mode"))


CONFIG = FailsafeConfig(patience=2.0)


def test_a_healthy_policy_is_passed_unchanged():
    bench = Bench()
    given = {"velocity_setpoint": [1.0, 0.5, 0.1, 0.5], "command": [10.0, 0.1, -0.2, 0.3]}
    bench.give(**given)
    bench.advance(0.06)
    expected = given | {"state_is_known": 1, "is_ready": 1, "in_charge": 1, "mode": FLYING}
    assert all(np.array_equal(bench.out(port), value) for port, value in expected.items())


def test_after_a_fault_the_vehicle_stops_and_then_lands():
    bench = Bench(CONFIG, v_WB=(3.0, 0.0, 0.0))
    bench.give(observation_age=1.0, velocity_setpoint=[3.0, 0.0, 0.0, np.nan])
    bench.advance(1.9)
    p = bench.state[:3].copy()
    assert np.linalg.norm(bench.state[3:6]) < 0.35
    assert 10.0 < p[0] < 13.0 and p[2] == pytest.approx(3.0, abs=0.2)
    bench.advance(0.2)
    assert bench.mode() == (status.LANDING, status.OBSERVATION_OLD)
    bench.advance(2.0)
    assert bench.state[2] == pytest.approx(p[2] - 1.0, abs=0.3)
    np.testing.assert_allclose(bench.state[:2], p[:2], atol=0.3)


FLYING, WAITING = (status.FLYING, status.NONE), (status.WAITING, status.NONE)
FROZEN, JUMPED = (status.HOLDING, status.STATE_FROZEN), (status.HOLDING, status.STATE_JUMPED)
HOLDING = status.HOLDING, status.OBSERVATION_OLD
LANDING = status.LANDING, status.OBSERVATION_OLD
OLD, NEW = {"observation_age": 1.0}, {"observation_age": 0.0}
HEARD, UNHEARD = {"vehicle_status_age": 0.0}, {"vehicle_status_age": 1.1}
OBEYS, DISARMED = {"vehicle_status": [1.0, 1.0]}, {"vehicle_status": [0.0, 1.0]}
STRAYS = {"vehicle_status": [1.0, 0.0]}


def landing_of_a_vehicle_that_does_not_obey(others: dict) -> list:
    return [
        (OLD | others | HEARD, 2.5, HOLDING, 0),
        (OBEYS, 1.9, HOLDING, 1),
        ({}, 0.2, LANDING, 1),
        (others, 0.06, HOLDING, 0),
        (NEW, 0.6, FLYING, 0),
    ]


@pytest.mark.parametrize(
    "steps",
    [
        [({"observation_age": np.inf}, 5.0, WAITING, 1), (NEW, 0.06, FLYING, 1)],
        [
            (NEW, 0.1, FLYING, 1),
            (OLD, 0.2, HOLDING, 1),
            (NEW, 0.4, HOLDING, 1),
            ({}, 0.2, FLYING, 1),
        ],
        [(OLD, 2.2, LANDING, 1), (NEW, 2.0, LANDING, 1)],
        landing_of_a_vehicle_that_does_not_obey(STRAYS),
        landing_of_a_vehicle_that_does_not_obey(DISARMED),
        [
            (OLD | OBEYS | UNHEARD, 2.5, HOLDING, 0),
            (HEARD, 0.06, HOLDING, 1),
            (UNHEARD, 2.2, LANDING, 0),
        ],
    ],
    ids=["first inputs", "recovery", "patience", "strays", "disarmed", "old status"],
)
def test_modes_follow_the_inputs(steps):
    bench = Bench(CONFIG, v_WB=(0.1, 0.0, 0.0))
    for inputs, duration, mode, in_charge in steps:
        bench.give(**inputs)
        bench.advance(duration)
        assert (bench.mode(), bench.out("in_charge")) == (mode, in_charge)
        assert bench.out("is_ready") == (mode != WAITING)


def test_a_vehicle_is_held_where_its_pilot_left_it():
    bench = Bench(FailsafeConfig(patience=20.0))
    bench.give(observation_age=1.0, vehicle_status=[1.0, 0.0], vehicle_status_age=0.0)
    bench.advance(1.0)
    assert bench.mode()[0] == status.HOLDING
    bench.state[:3] += [1.0, 0.0, 0.5]  # by the pilot
    bench.advance(0.5)
    bench.give(vehicle_status=[1.0, 1.0])
    bench.advance(0.1)
    np.testing.assert_allclose(bench.out("velocity_setpoint")[:3], 0.0, atol=0.05)


def test_a_vehicle_that_tips_over_is_leveled():
    bench = Bench()
    bench.advance(0.06)
    tilted = hover_state([10.0, 0.0, 3.0])
    tilted[6:10] = np.cos(0.6), np.sin(0.6), 0.0, 0.0  # 1.2 rad about x
    bench.give_state(tilted)
    assert bench.mode() == (status.HOLDING, status.TILTED)
    assert bench.out("command")[1] < -3.0


@pytest.mark.parametrize(
    ("gradient", "descends"), [([0.0, 0.0, 1.0], True), ([0.8, 0.0, 0.6], False)]
)
def test_landing_touches_only_level_surfaces(gradient, descends):
    bench = Bench(CONFIG)
    bench.give(observation_age=1.0, clearance=0.1, gradient=gradient)
    bench.advance(2.2, measured=lambda now: hover_state([10.0 + 1e-3 * now, 0.0, 3.0]))
    assert bench.out("mode")[0] == status.LANDING
    v = bench.out("velocity_setpoint")[:3]
    assert (v[2] == pytest.approx(-0.5)) == descends
    assert descends or v.dot(gradient) >= -0.01


WIDE = np.full(3, -60.0), np.full(3, 60.0)
WALL = AnalyticDistanceField([Box(RigidTransform([0.5, 0, 0]), np.array([1.0, 90, 90]))], *WIDE)
POST = AnalyticDistanceField([Cylinder(p_WA=[0.5, 0, -50], p_WB=[0.5, 0, 50], radius=0.5)], *WIDE)


@given(
    numbers=st.lists(st.floats(-1e4, 1e4), min_size=16, max_size=16),
    age=st.floats(-0.2, 0.3),
    max_speed=st.floats(0.1, 6.0),
    mode=st.sampled_from([status.FLYING, status.HOLDING, status.LANDING]),
    is_known=st.booleans(),
    has_map=st.booleans(),
)
def test_no_state_and_no_map_is_flown_faster_than_the_limit(
    numbers, age, max_speed, mode, is_known, has_map
):
    p_WB, v_WB, desired, held, gradient = np.reshape(numbers[:15], (5, 3))
    limits, box = FlightLimits(max_speed=max_speed), flight_limits.Box(-np.ones(3), np.ones(3))
    motion = Motion.predict(p_WB, v_WB, age, 0.1, limits.deceleration, LAW) if is_known else None
    clearance, field = (numbers[15], POST) if has_map else (math.nan, None)
    near, config = Surroundings(clearance, gradient, box, field), FailsafeConfig(limits=limits)
    setpoint, _ = Modes(mode, p_WH=held).setpoint(np.append(desired, 0.0), motion, near, config)
    fastest = max_speed if mode == status.FLYING else min(max_speed, RETURN_SPEED)
    assert np.linalg.norm(setpoint[:3]) <= fastest * (1 + 1e-9)


def test_from_outside_the_fence_the_vehicle_returns_slowly():
    bench = Bench(p_WB=(25.0, 0.0, 3.0))
    bench.advance(0.06)
    assert bench.mode() == (status.HOLDING, status.OUTSIDE)
    bench.advance(4.0)
    assert bench.state[0] < 22.0
    fastest = np.linalg.norm(np.array(bench.states)[:, 3:6], axis=1).max()
    assert 0.9 * RETURN_SPEED < fastest < 1.05 * RETURN_SPEED


AHEAD = {
    "wall": (WALL, WIDE, [1.0, 0.0, 0.0]),
    "post": (POST, WIDE, [1.0, 0.0, 0.0]),
    "fence": (None, (WIDE[0], np.array([0.0, 60.0, 60.0])), [1.0, 0.0, 0.0]),
    "floor": (None, (np.array([-60.0, -60.0, 0.0]), WIDE[1]), [0.0, 0.0, -1.0]),
    "ceiling": (None, (WIDE[0], np.array([60.0, 60.0, 0.0])), [0.0, 0.0, 1.0]),
}
HEAD_ON = [
    *itertools.product(["wall", "post"], ["velocity", "body_rates"], [0.1], [6.0]),
    *itertools.product(["wall", "fence", "floor", "ceiling"], ["velocity"], [0.3], [3.0]),
    *itertools.product(["fence", "ceiling"], ["body_rates"], [0.1], [1.0]),
    ("floor", "body_rates", 0.0, 6.0),
]


@pytest.mark.parametrize(("what", "by", "age", "speed"), HEAD_ON)
def test_limits_are_kept_head_on_at_any_speed_and_age(what, by, age, speed):
    field, box, direction = AHEAD[what]
    v_WB = speed * np.array(direction)
    motion = Motion.predict(np.zeros(3), v_WB, age, 0.0, FlightLimits().deceleration, LAW)
    away = VEHICLE_RADIUS + 0.1 + np.linalg.norm(motion.stop) + motion.reaction_time * speed
    bench = Bench(None, -(away + 0.2) * np.array(direction), v_WB, age, by, box, field)
    for _ in range(120):
        bench.advance(0.02, desired=v_WB)
        assert bench.out("mode")[0] == status.FLYING
    assert bench.min_room >= -1e-3
    assert bench.out("mode")[1] in (status.LIMITED_CLEARANCE, status.LIMITED_GEOFENCE)


@pytest.mark.parametrize("moment", [0.2, 0.8])
@pytest.mark.parametrize("what", ["post", "fence"])
def test_limits_are_kept_if_the_policy_is_lost_on_the_way(what, moment):
    field, box, direction = AHEAD[what]
    v_WB = 4.0 * np.array(direction)
    bench = Bench(None, -5.0 * np.array(direction), v_WB, 0.02, "body_rates", box, field)
    bench.advance(moment, desired=v_WB)
    bench.give(observation_age=1.0)
    bench.advance(2.0)
    assert bench.min_room >= -1e-3
    assert np.linalg.norm(bench.state[3:6]) < 0.1


@pytest.mark.parametrize("what", ["post", "fence"])
def test_limits_are_kept_by_the_radius_of_the_vehicle(what):
    field, box, direction = AHEAD[what]
    bench = Bench(None, (-3.0, 0.3, 0.0), direction, 0.02, "body_rates", box, field, radius=0.6)
    bench.advance(3.0, desired=direction)
    assert -1e-3 <= bench.min_room < 0.15


@pytest.mark.parametrize("seed", range(2))
def test_limits_are_kept_for_any_accelerations(seed):
    random = np.random.default_rng(seed)
    bench = Bench(None, (-3.0, 0.0, 0.0), (0.01, 0.0, 0.0), 0.02, "body_rates", WIDE, POST)
    for _ in range(20):
        a_WB = random.uniform(-8.0, 8.0, 3) * [1, 1, 0.2] - 0.5 * bench.state[:3]
        for _ in range(10):
            bench.accelerate(a_WB)
            bench.advance(0.02)
    assert bench.min_room >= -1e-2


def test_in_free_space_the_desired_velocity_is_flown():
    bench = Bench(None, (-20.0, 0.0, 0.0), (6.0, 0.0, 0.0), 0.02, "body_rates", WIDE, POST)
    reach = float(np.linalg.norm(stopping_displacement(np.array([6.0, 0, 0]), 0.4, 5.0)))
    while bench.state[0] < -(reach + 6.0 * math.e * 0.16 + 1.0):
        bench.advance(0.02, desired=[6.0, 0.0, 0.0])
        assert bench.out("mode")[1] in (status.NONE, status.LIMITED_SPEED)


def test_a_policy_that_desires_too_fast_flight_is_flown_at_the_limit():
    config = FailsafeConfig(limits=FlightLimits(max_speed=4.0))
    bench = Bench(config, (-40.0, 0.0, 0.0), (1e-3, 0.0, 0.0), 0.02, "body_rates", WIDE)
    bench.advance(2.0, desired=[9.0, 0.0, 0.0])
    assert 3.9 < bench.state[3] and np.array(bench.states)[:, 3].max() < 1.05 * 4.0
    assert bench.mode() == (status.FLYING, status.LIMITED_SPEED)


def test_a_vector_is_replaced_if_any_element_is_not_finite():
    system = FiniteVector(2, -1.0)
    context = system.CreateDefaultContext()
    for signal, finite in (([1, -2], [1, -2]), ([1, np.nan], [-1, -1]), ([-np.inf, 0], [-1, -1])):
        system.GetInputPort("signal").FixValue(context, signal)
        np.testing.assert_array_equal(system.GetOutputPort("finite").Eval(context), finite)


FAULTS = [
    (status.STATE_OLD, {"state_age": 0.31}),
    (status.OBSERVATION_OLD, {"observation_age": 0.31}),
    (status.BODY_LOST, {"body_age": 0.31}),
    (status.OVERRUN, {"lag": 0.31}),
    (status.POLICY_FAILED, {"policy_failed": 1.0}),
    (status.NOT_FINITE, {"command": [np.nan, 0.0, 0.0, 0.0]}),
    (status.NOT_FINITE, {"velocity_setpoint": [np.nan, 0.0, 0.0, 0.0]}),
    (status.NOT_FINITE, {"velocity_setpoint": [0.0, 0.0, 0.0, np.inf]}),
    (status.OUT_OF_BOUNDS, {"command": [-0.1, 0.0, 0.0, 0.0]}),
    (status.OUT_OF_BOUNDS, {"command": [20.3, 0.0, 0.0, 0.0]}),
    (status.OUT_OF_BOUNDS, {"command": [10.0, 0.0, 0.0, 2.1]}),
    (status.OUT_OF_BOUNDS, {"command": [10.0, 7.0, 0.0, 0.0]}),
    (status.NONE, {"velocity_setpoint": [0.0, 0.0, 0.0, np.nan]}),
    (status.NONE, {"command": [20.1, 6.0, -6.0, 2.0]}),
]


@pytest.mark.parametrize(("reason", "inputs"), FAULTS)
def test_a_fault_takes_effect_at_once(reason, inputs):
    bench = Bench(v_WB=(3.0, 0.0, 0.0))
    bench.give(observation_age=0.0, lag=0.0)
    bench.advance(0.1, desired=[3.0, 0.0, 0.0])
    assert bench.out("mode")[0] == status.FLYING
    bench.give(**inputs)
    assert bench.mode() == (status.HOLDING if reason else status.FLYING, reason)
    if reason:
        np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))
    assert np.isfinite(bench.out("command")).all()
    assert bench.out("state_is_known") == (reason != status.STATE_OLD)


def test_the_most_severe_reason_is_told():
    bench = Bench(CONFIG)
    for reason in (
        *(status.OUT_OF_BOUNDS, status.NOT_FINITE, status.POLICY_FAILED, status.OBSERVATION_OLD),
        *(status.OVERRUN, status.BODY_LOST),
    ):
        bench.give(**dict(FAULTS)[reason])
        bench.advance(0.04)
        assert bench.mode() == (status.HOLDING, reason)
    bench.give(body_age=0.0)
    bench.advance(0.04)
    assert bench.out("mode")[1] == status.BODY_LOST


def moving(p_WB, v_WB, since: float = 0.0):
    """The states of a vehicle that passes p_WB at time `since` with a velocity."""
    attitude = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    return lambda now: np.r_[np.add(p_WB, np.multiply(v_WB, now - since)), v_WB, attitude]


@pytest.mark.parametrize(
    ("speed", "first"), [(0.0, {}), (2.0, {}), (0.0, {"observation_age": 1.0}), (2.0, {"lag": 1.0})]
)
def test_a_state_that_does_not_change_is_frozen_at_any_speed_in_any_mode(speed, first):
    bench = Bench(CONFIG)
    frozen = moving([10.0, 0.0, 3.0], [speed, 0.0, 0.0])(0.0)
    bench.give(**first)
    bench.advance(0.14, measured=lambda now: frozen)
    assert bench.out("state_is_known") == 0  # Body rates need newer states than velocities.
    assert bench.out("mode")[0] == (status.HOLDING if first else status.FLYING)
    bench.advance(0.26, measured=lambda now: frozen)
    assert bench.mode() == FROZEN
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))


def test_a_state_that_changes_again_is_used_again_while_landing():
    bench = Bench(CONFIG)
    bench.advance(2.6, measured=lambda now: hover_state([20.5, 0.0, 3.0]))
    assert bench.mode() == (status.LANDING, status.STATE_FROZEN)
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], [0.0, 0.0, -0.5])
    bench.advance(0.2, measured=moving([20.5, 0.0, 3.0], [0.1, 0.0, 0.0], since=2.6))
    assert bench.out("mode")[0] == status.LANDING
    assert bench.out("state_is_known") == 1
    assert bench.out("velocity_setpoint")[0] < -0.5


def shifted(path, p_WB=(0.0, 0.0, 0.0), v_WB=(0.0, 0.0, 0.0), angle: float = 0.0):
    """The states of a path without rotation, elsewhere, faster and with another heading."""
    attitude = [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]
    return lambda now: np.r_[(path(now)[:6] + np.r_[p_WB, v_WB]), attitude, np.zeros(3)]


PATH = moving([10.0, 0.0, 3.0], [0.2, 0.0, 0.0])
STOPPED = moving([10.2, 0.0, 3.0], [0.01, 0.0, 0.0], since=1.0)
FLIES, LOST = (0.4, PATH, FLYING), (0.5, lambda now: PATH(0.4), FROZEN)
ASIDE, TURNED = {"p_WB": [0.0, 3.0, 0.0]}, {"angle": 2.9}


@pytest.mark.parametrize(
    ("inputs", "steps"),
    [
        ({}, [FLIES, (1.2, shifted(PATH, **ASIDE), JUMPED), (0.7, PATH, FLYING)]),
        ({}, [FLIES, (0.3, shifted(PATH, v_WB=[5.0, 0.0, 0.0]), JUMPED)]),
        ({}, [FLIES, (0.3, shifted(PATH, **TURNED), JUMPED)]),
        ({}, [FLIES, LOST, (1.0, shifted(STOPPED, **ASIDE), FROZEN), (0.7, STOPPED, FLYING)]),
        ({}, [FLIES, LOST, (1.0, shifted(STOPPED, **TURNED), FROZEN), (0.7, STOPPED, FLYING)]),
        (STRAYS | HEARD, [FLIES, LOST, (0.7, shifted(STOPPED, **ASIDE, **TURNED), FLYING)]),
    ],
    ids=["position", "velocity", "heading", "lost position", "lost heading", "moved by its pilot"],
)
def test_a_state_that_jumped_is_used_again_when_it_comes_back(inputs, steps):
    bench = Bench(CONFIG)
    bench.give(**inputs)
    for duration, measured, mode in steps:
        bench.advance(duration, measured=measured)
        assert (bench.mode(), bench.out("state_is_known")) == (mode, mode == FLYING)
        assert mode == FLYING or not bench.out("velocity_setpoint")[:3].any()


def test_flight_during_a_lag_of_the_process_is_not_a_jump():
    bench = Bench(CONFIG)
    path = moving([6.0, 0.0, 3.0], [3.0, 0.0, 0.0])
    for lag in [0.0] * 20 + [0.25] * 20 + [0.8] * 20:
        bench.give(unix_time=bench.tick * PERIOD + lag)
        bench.advance(PERIOD, measured=lambda now, lag=lag: path(now + lag))
        assert bench.mode() == FLYING


def test_harsh_flight_is_not_a_jump():
    bench = Bench(replace(CONFIG, limits=FlightLimits(max_tilt=1.5)), box=(LOWER - 50, UPPER + 50))
    random = np.random.default_rng(0)
    for _ in range(100):
        command = np.append(random.uniform(5, 20), random.uniform(-6, 6, 3) * [1, 1, 0.3])
        bench.give(velocity_setpoint=[0.0, 0.0, 0.0, np.nan], command=command)
        bench.advance(0.02)
        assert bench.out("mode")[1] != status.STATE_JUMPED
