from dataclasses import replace

import numpy as np
import pytest
from failsafe_bench import LOWER, UPPER, Bench

from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.quadrotor import hover_state

CONFIG = FailsafeConfig(patience=2.0)

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
    assert bench.out("state_is_known")[0] == (reason != status.STATE_OLD)


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


@pytest.mark.parametrize("speed", [0.0, 2.0])
@pytest.mark.parametrize("first", [{}, {"observation_age": 1.0}, {"lag": 1.0}])
def test_a_state_that_does_not_change_is_frozen_at_any_speed_in_any_mode(speed, first):
    bench = Bench(CONFIG)
    frozen = moving([10.0, 0.0, 3.0], [speed, 0.0, 0.0])(0.0)
    bench.give(**first)
    bench.advance(0.4, measured=lambda now: frozen)
    assert bench.mode() == (status.HOLDING, status.STATE_FROZEN)
    assert bench.out("state_is_known")[0] == 0
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))


def test_body_rates_are_flown_only_by_states_that_change():
    bench = Bench(CONFIG)
    bench.advance(0.2)
    assert bench.out("state_is_known")[0] == 1
    frozen = bench.state.copy()
    bench.advance(0.14, measured=lambda now: frozen)
    assert bench.out("state_is_known")[0] == 0
    assert bench.out("mode")[0] == status.FLYING


def test_a_state_that_changes_again_is_used_again_while_landing():
    bench = Bench(CONFIG)
    bench.advance(2.6, measured=lambda now: hover_state([10.0, 0.0, 3.0]))
    assert bench.mode() == (status.LANDING, status.STATE_FROZEN)
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], [0.0, 0.0, -0.5])
    bench.advance(0.2, measured=moving([20.5, 0.0, 3.0], [0.1, 0.0, 0.0], since=2.6))
    assert bench.out("mode")[0] == status.LANDING
    assert bench.out("state_is_known")[0] == 1
    assert bench.out("velocity_setpoint")[0] < -0.5


def rotated(state: np.ndarray, angle: float) -> np.ndarray:
    return np.r_[state[:6], np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2), state[10:]]


JUMPS = {
    "position": lambda state: state + np.r_[0.0, 3.0, np.zeros(11)],
    "velocity": lambda state: state + np.r_[np.zeros(3), 5.0, np.zeros(9)],
    "heading": lambda state: rotated(state, 2.9),
}


@pytest.mark.parametrize("what", JUMPS)
def test_a_state_that_jumped_is_used_again_when_it_comes_back(what):
    bench = Bench(CONFIG)
    path = moving([10.0, 0.0, 3.0], [0.5, 0.0, 0.0])
    bench.advance(0.4, measured=path)
    assert bench.out("mode")[0] == status.FLYING
    bench.advance(0.3 if what != "position" else 1.2, measured=lambda now: JUMPS[what](path(now)))
    assert bench.mode() == (status.HOLDING, status.STATE_JUMPED)
    if what == "position":
        np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))
        assert bench.out("state_is_known")[0] == 0
        bench.advance(0.7, measured=path)
        assert bench.out("mode")[0] == status.FLYING
        assert bench.out("state_is_known")[0] == 1


def test_harsh_flight_is_not_a_jump():
    bench = Bench(replace(CONFIG, limits=FlightLimits(max_tilt=1.5)), box=(LOWER - 50, UPPER + 50))
    random = np.random.default_rng(0)
    for _ in range(100):
        command = np.append(random.uniform(5, 20), random.uniform(-6, 6, 3) * [1, 1, 0.3])
        bench.give(velocity_setpoint=[0.0, 0.0, 0.0, np.nan], command=command)
        bench.advance(0.02)
        assert bench.out("mode")[1] != status.STATE_JUMPED
