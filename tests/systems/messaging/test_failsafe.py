"""Failsafe."""

from dataclasses import replace

import numpy as np
import pytest
from failsafe_bench import LOWER, UPPER, Bench

from splatpilot.systems.messaging.failsafe import FailsafeConfig, FiniteVector
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.quadrotor import hover_state

CONFIG = FailsafeConfig(patience=2.0)

IN_CHARGE, NOT_IN_CHARGE = [1.0, 1.0], [1.0, 0.0]


def test_all_well_passes_as_it_is():
    bench = Bench()
    told, command = [1.0, 0.5, 0.1, 0.5], [10.0, 0.1, -0.2, 0.3]
    bench.give(velocity_setpoint=told, command=command)
    bench.advance(0.06)
    np.testing.assert_array_equal(bench.out("mode"), [status.FLYING, status.NONE])
    np.testing.assert_array_equal(bench.out("velocity_setpoint"), told)
    np.testing.assert_array_equal(bench.out("command"), command)
    for port in ("state_is_known", "is_ready", "in_charge"):
        assert bench.out(port)[0] == 1


FAULTS = {
    status.STATE_OLD: {"state_age": 0.31},
    status.OBSERVATION_OLD: {"observation_age": 0.31},
    status.BODY_LOST: {"body_age": 0.31},
    status.OVERRUN: {"lag": 0.31},
    status.POLICY_FAILED: {"policy_failed": 1.0},
    status.NOT_FINITE: {"command": [np.nan, 0.0, 0.0, 0.0]},
    status.OUT_OF_BOUNDS: {"command": [10.0, 7.0, 0.0, 0.0]},
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_fault_is_a_fault_at_once(reason):
    bench = Bench(v_WB=(3.0, 0.0, 0.0))
    bench.give(observation_age=0.0, lag=0.0)
    bench.advance(0.1, want=[3.0, 0.0, 0.0])
    assert bench.out("mode")[0] == status.FLYING
    bench.give(**FAULTS[reason])
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, reason])
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))
    assert np.isfinite(bench.out("command")).all()
    assert bench.out("state_is_known")[0] == (reason != status.STATE_OLD)


def test_after_a_fault_the_vehicle_stops_and_then_lands():
    bench = Bench(CONFIG, v_WB=(3.0, 0.0, 0.0))
    bench.give(observation_age=1.0, velocity_setpoint=[3.0, 0.0, 0.0, np.nan])
    bench.advance(1.9)
    p = bench.state[:3].copy()
    assert np.linalg.norm(bench.state[3:6]) < 0.35
    assert 10.0 < p[0] < 13.0 and p[2] == pytest.approx(3.0, abs=0.2)
    bench.advance(0.2)
    np.testing.assert_array_equal(bench.out("mode"), [status.LANDING, status.OBSERVATION_OLD])
    bench.advance(2.0)
    assert bench.state[2] == pytest.approx(p[2] - 1.0, abs=0.3)
    np.testing.assert_allclose(bench.state[:2], p[:2], atol=0.3)


def test_a_moment_is_forgiven_and_landing_is_not_taken_back():
    bench = Bench(CONFIG, v_WB=(0.1, 0.0, 0.0))
    bench.advance(0.1)
    bench.give(observation_age=1.0)
    bench.advance(0.2)
    bench.give(observation_age=0.0)
    bench.advance(0.4)
    assert bench.out("mode")[0] == status.HOLDING
    bench.advance(0.2)
    np.testing.assert_array_equal(bench.out("mode"), [status.FLYING, status.NONE])
    bench.give(observation_age=1.0)
    bench.advance(2.2)
    bench.give(observation_age=0.0)
    bench.advance(2.0)
    np.testing.assert_array_equal(bench.out("mode"), [status.LANDING, status.OBSERVATION_OLD])


def test_nothing_is_commanded_before_the_first_state_and_observation():
    bench = Bench()
    bench.give(observation_age=np.inf)
    bench.advance(5.0)
    np.testing.assert_array_equal(bench.out("mode"), [status.WAITING, status.NONE])
    assert bench.out("is_ready")[0] == bench.out("state_is_known")[0] == 0
    bench.give(observation_age=0.1, command=[10.0, 0.0, 0.0, 0.0])
    bench.advance(0.06)
    assert bench.out("mode")[0] == status.FLYING


def moving(p_WB, v_WB, since: float = 0.0):
    """The states of a vehicle that passes p_WB at time `since` with a velocity."""
    return lambda now: np.r_[np.add(p_WB, np.multiply(v_WB, now - since)), v_WB, HOVER_ATTITUDE]


HOVER_ATTITUDE = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("speed", [0.0, 0.1, 2.0])
@pytest.mark.parametrize("first", [{}, {"observation_age": 1.0}, {"lag": 1.0}])
def test_a_state_that_does_not_change_is_frozen_at_any_speed_in_any_mode(speed, first):
    bench = Bench(CONFIG)
    frozen = moving([10.0, 0.0, 3.0], [speed, 0.0, 0.0])(0.0)
    bench.give(**first)
    bench.advance(0.4, measured=lambda now: frozen)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.STATE_FROZEN])
    assert bench.out("state_is_known")[0] == 0
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))


def test_body_rates_are_flown_by_states_that_change_alone():
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
    np.testing.assert_array_equal(bench.out("mode"), [status.LANDING, status.STATE_FROZEN])
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], [0.0, 0.0, -0.5])
    bench.advance(0.2, measured=moving([20.5, 0.0, 3.0], [0.1, 0.0, 0.0], since=2.6))
    assert bench.out("mode")[0] == status.LANDING
    assert bench.out("state_is_known")[0] == 1
    assert bench.out("velocity_setpoint")[0] < -0.5


def turned(state: np.ndarray, angle: float) -> np.ndarray:
    return np.r_[state[:6], np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2), state[10:]]


JUMPS = {
    "position": lambda state: state + np.r_[0.0, 3.0, np.zeros(11)],
    "velocity": lambda state: state + np.r_[np.zeros(3), 5.0, np.zeros(9)],
    "heading": lambda state: turned(state, 2.9),
}


@pytest.mark.parametrize("what", JUMPS)
def test_states_that_do_not_follow_from_those_before_are_not_flown_by(what):
    bench = Bench(CONFIG)
    path = moving([10.0, 0.0, 3.0], [0.5, 0.0, 0.0])
    bench.advance(0.4, measured=path)
    assert bench.out("mode")[0] == status.FLYING
    bench.advance(0.3, measured=lambda now: JUMPS[what](path(now)))
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.STATE_JUMPED])


def test_a_state_that_jumped_is_used_again_when_it_comes_back():
    bench = Bench(CONFIG)
    path = moving([10.0, 0.0, 3.0], [0.5, 0.0, 0.0])
    bench.advance(0.4, measured=path)
    bench.advance(1.2, measured=lambda now: JUMPS["position"](path(now)))
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.STATE_JUMPED])
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))
    assert bench.out("state_is_known")[0] == 0
    bench.advance(0.7, measured=path)
    assert bench.out("mode")[0] == status.FLYING
    assert bench.out("state_is_known")[0] == 1


def test_harsh_flight_is_no_jump():
    bench = Bench(replace(CONFIG, limits=FlightLimits(max_tilt=1.5)), box=(LOWER - 50, UPPER + 50))
    random = np.random.default_rng(0)
    for _ in range(100):
        command = np.append(random.uniform(5, 20), random.uniform(-6, 6, 3) * [1, 1, 0.3])
        bench.give(velocity_setpoint=[0.0, 0.0, 0.0, np.nan], command=command)
        bench.advance(0.02)
        assert bench.out("mode")[1] != status.STATE_JUMPED


def test_the_most_severe_reason_is_told():
    bench = Bench(CONFIG)
    for reason, fault in (
        (status.OUT_OF_BOUNDS, {"command": [10.0, 7.0, 0.0, 0.0]}),
        (status.NOT_FINITE, {"command": [np.nan, 0.0, 0.0, 0.0]}),
        (status.OBSERVATION_OLD, {"observation_age": 1.0}),
        (status.BODY_LOST, {"body_age": 1.0}),
    ):
        bench.give(**fault)
        bench.advance(0.04)
        np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, reason])
    bench.give(body_age=0.0)
    bench.advance(0.04)
    assert bench.out("mode")[1] == status.BODY_LOST


def test_a_vehicle_that_tips_over_is_leveled():
    bench = Bench()
    bench.advance(0.06)
    tilted = hover_state([10.0, 0.0, 3.0])
    tilted[6:10] = np.cos(0.6), np.sin(0.6), 0.0, 0.0  # 1.2 rad about x
    bench.give_state(tilted)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.TILTED])
    assert bench.out("command")[1] < -3.0


def test_outside_the_fence_the_vehicle_is_led_back():
    limits = FlightLimits(geofence=[[0.0, -5, 0], [9.5, 5, 6]])
    bench = Bench(replace(CONFIG, limits=limits))
    bench.advance(0.06)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.OUTSIDE])
    bench.advance(1.9)
    assert bench.state[0] < 9.6


def test_landing_is_let_down_on_what_is_level_and_on_nothing_else():
    for gradient, descends in (([0.0, 0.0, 1.0], True), ([0.8, 0.0, 0.6], False)):
        bench = Bench(CONFIG)
        bench.give(observation_age=1.0, clearance=0.1, gradient=gradient)
        bench.advance(2.2, measured=moving([10.0, 0.0, 3.0], [1e-3, 0.0, 0.0]))
        assert bench.out("mode")[0] == status.LANDING
        v = bench.out("velocity_setpoint")[:3]
        assert (v[2] == pytest.approx(-0.5)) == descends
        assert descends or v.dot(gradient) >= -0.01


def test_patience_is_counted_in_charge_alone():
    bench = Bench(CONFIG, v_WB=(0.1, 0.0, 0.0))
    bench.give(vehicle_status=NOT_IN_CHARGE, vehicle_status_age=0.0, observation_age=1.0)
    bench.advance(5.0)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.OBSERVATION_OLD])
    bench.give(vehicle_status=IN_CHARGE)
    bench.advance(1.9)
    assert bench.out("mode")[0] == status.HOLDING
    bench.advance(0.2)
    assert bench.out("mode")[0] == status.LANDING


@pytest.mark.parametrize("told", [NOT_IN_CHARGE, [0.0, 1.0]])
def test_a_landing_ends_when_the_vehicle_is_flown_by_another(told):
    bench = Bench(CONFIG, v_WB=(0.1, 0.0, 0.0))
    bench.give(vehicle_status=IN_CHARGE, vehicle_status_age=0.0, observation_age=1.0)
    bench.advance(2.2)
    assert bench.out("mode")[0] == status.LANDING
    bench.give(vehicle_status=told)
    bench.advance(0.06)
    assert bench.out("in_charge")[0] == 0
    assert bench.out("mode")[0] == status.HOLDING
    bench.give(observation_age=0.0)
    bench.advance(0.6)
    assert bench.out("mode")[0] == status.FLYING


def test_an_old_status_begins_no_landing_and_ends_none():
    bench = Bench(CONFIG, v_WB=(0.1, 0.0, 0.0))
    bench.give(vehicle_status=IN_CHARGE, vehicle_status_age=1.1, observation_age=1.0)
    bench.advance(4.0)
    assert bench.out("in_charge")[0] == 0
    assert bench.out("mode")[0] == status.HOLDING
    bench.give(vehicle_status_age=0.0)
    bench.advance(0.06)
    bench.give(vehicle_status_age=1.1)
    bench.advance(2.2)
    assert bench.out("in_charge")[0] == 0
    assert bench.out("mode")[0] == status.LANDING


def test_a_vehicle_on_the_ground_below_its_fence_takes_off_into_it():
    limits = FlightLimits(geofence=[[0.0, -5, 1.0], [20.0, 5, 6]])
    bench = Bench(replace(CONFIG, limits=limits), p_WB=(10.0, 0.0, 0.1))
    bench.give(vehicle_status=NOT_IN_CHARGE, vehicle_status_age=0.0)
    bench.advance(0.1)
    np.testing.assert_array_equal(bench.out("mode"), [status.FLYING, status.LIMITED_GEOFENCE])
    bench.give(vehicle_status=IN_CHARGE)
    bench.advance(0.4)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.OUTSIDE])
    bench.advance(1.8)
    assert bench.out("mode")[0] == status.FLYING
    assert bench.state[2] > 1.0


@pytest.mark.parametrize("name", ["max_age", "max_lag", "recovery", "patience", "descent"])
def test_bad_config_is_named(name):
    with pytest.raises(ValueError, match=rf"{name} must be in .* got 0"):
        FailsafeConfig(**{name: 0.0}).validate()


@pytest.mark.parametrize(
    ("signal", "finite"),
    [([1.0, -2.0], [1.0, -2.0]), ([1.0, np.nan], [0.0, 0.0]), ([-np.inf, 0.0], [0.0, 0.0])],
)
def test_signal_is_whole_or_zero(signal, finite):
    system = FiniteVector(2)
    context = system.CreateDefaultContext()
    system.GetInputPort("signal").FixValue(context, signal)
    np.testing.assert_array_equal(system.GetOutputPort("finite").Eval(context), finite)


def test_what_is_not_finite_becomes_the_substitute():
    system = FiniteVector(1, substitute=np.nan)
    context = system.CreateDefaultContext()
    for signal, finite in ((0.5, 0.5), (np.inf, np.nan), (np.nan, np.nan)):
        system.GetInputPort("signal").FixValue(context, [signal])
        np.testing.assert_array_equal(system.GetOutputPort("finite").Eval(context), [finite])
