"""What is flown where policy, state or observation cannot be trusted."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.messaging.failsafe import Failsafe
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.flight_limits import FlightLimits
from splatpilot.systems.vehicle.quadrotor_dynamics import GRAVITY, QuadrotorParams, hover_state
from splatpilot.systems.vehicle.quadrotor_plant import QuadrotorPlant

LOWER, UPPER = np.array([0.0, -5.0, 0.0]), np.array([20.0, 5.0, 6.0])
HOVER = np.array([GRAVITY, 0.0, 0.0, 0.0])
CONFIG = FailsafeConfig(patience=2.0)


class Bench:
    """A failsafe whose inputs the test gives, and a vehicle that does as it is told or, where
    `flies` is False, stays where it is."""

    def __init__(self, config: FailsafeConfig = CONFIG, flies: bool = True, v=(0.0, 0.0, 0.0)):
        builder = DiagramBuilder()
        self.plant = builder.AddSystem(QuadrotorPlant())
        law, vehicle = FlatnessControllerConfig(), QuadrotorParams()
        self.failsafe = builder.AddSystem(Failsafe(config, law, vehicle, LOWER, UPPER))
        start = hover_state([10.0, 0.0, 3.0])
        start[3:6] = v
        state, command = self.plant.GetOutputPort("state"), self.failsafe.command_output_port()
        if flies:
            builder.Connect(state, self.failsafe.state_input_port())
            builder.Connect(state, self.failsafe.measured_state_input_port())
            builder.Connect(command, self.plant.GetInputPort("command"))
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.context = self.failsafe.GetMyMutableContextFromRoot(self.root)
        plant = self.plant.GetMyMutableContextFromRoot(self.root)
        plant.SetContinuousState(start)
        if not flies:
            self.plant.GetInputPort("command").FixValue(plant, HOVER)
            self.give(state=start, measured_state=start)
        self.give(state_age=0.0, velocity_setpoint=[0.0, 0.0, 0.0, 0.5], command=HOVER)

    def give(self, **inputs) -> None:
        for name, value in inputs.items():
            self.failsafe.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))

    def advance(self, duration: float) -> None:
        self.simulator.AdvanceTo(self.root.get_time() + duration)

    def out(self, name: str) -> np.ndarray:
        return self.failsafe.GetOutputPort(name).Eval(self.context)

    def state(self) -> np.ndarray:
        return self.plant.GetOutputPort("state").Eval(self.plant.GetMyContextFromRoot(self.root))


def test_all_well_passes_as_it_is():
    """Setpoint, heading and command of a policy that keeps the limits are sent unchanged."""
    bench = Bench()
    told, command = [1.0, 0.5, 0.1, 0.5], [10.0, 0.1, -0.2, 0.3]
    bench.give(velocity_setpoint=told, command=command)
    bench.advance(0.05)
    np.testing.assert_array_equal(bench.out("mode"), [status.FLYING, status.NONE])
    np.testing.assert_array_equal(bench.out("velocity_setpoint"), told)
    np.testing.assert_array_equal(bench.out("command"), command)
    assert bench.out("state_is_known")[0] == bench.out("in_charge")[0] == 1


FAULTS = {
    status.STATE_OLD: {"state_age": 0.31},
    status.OBSERVATION_OLD: {"observation_age": 0.31},
    status.BODY_LOST: {"body_age": 0.31},
    status.OVERRUN: {"lag": 0.31},
    status.NOT_FINITE: {"command": [np.nan, 0.0, 0.0, 0.0]},
    status.OUT_OF_BOUNDS: {"command": [10.0, 7.0, 0.0, 0.0]},
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_fault_is_a_fault_at_once_and_the_vehicle_stops(reason):
    """From the very instant of a fault at 3 m/s nothing of the policy passes; the vehicle brakes,
    hovers where it came to rest, and descends after `patience`."""
    bench = Bench(v=(3.0, 0.0, 0.0))
    bench.give(velocity_setpoint=[3.0, 0.0, 0.0, np.nan], observation_age=0.0, lag=0.0)
    bench.advance(0.1)
    assert bench.out("mode")[0] == status.FLYING
    bench.give(**FAULTS[reason])
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, reason])
    assert np.isfinite(bench.out("command")).all()
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], np.zeros(3))
    assert bench.out("state_is_known")[0] == (reason != status.STATE_OLD)
    bench.advance(1.9)
    p, v = bench.state()[:3].copy(), bench.state()[3:6]
    assert np.linalg.norm(v) < 0.35
    assert 10.0 < p[0] < 13.0
    assert p[2] == pytest.approx(3.0, abs=0.2)
    bench.advance(0.2)
    np.testing.assert_array_equal(bench.out("mode"), [status.LANDING, reason])
    bench.advance(2.0)
    assert bench.state()[2] == pytest.approx(p[2] - 1.0, abs=0.3)
    np.testing.assert_allclose(bench.state()[:2], p[:2], atol=0.3)


def test_a_moment_is_forgiven_and_landing_is_not_taken_back():
    """When all has been well for `recovery` the policy flies on; a landing goes on."""
    bench = Bench()
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
    """Until both have come the failsafe is not in charge, however long that takes."""
    bench = Bench()
    bench.give(observation_age=np.inf)
    bench.advance(5.0)
    np.testing.assert_array_equal(bench.out("mode"), [status.WAITING, status.NONE])
    assert bench.out("in_charge")[0] == bench.out("state_is_known")[0] == 0
    bench.give(observation_age=0.1)
    bench.advance(0.05)
    assert bench.out("mode")[0] == status.FLYING


def test_a_state_that_stands_still_in_flight_is_no_state():
    """A position that does not change at 1 m/s is a fault after `max_age`; at rest it is none."""
    bench = Bench(flies=False)
    bench.advance(1.0)
    assert bench.out("mode")[0] == status.FLYING
    frozen = hover_state([10.0, 0.0, 3.0])
    frozen[3] = 1.0
    bench.give(state=frozen, measured_state=frozen)
    bench.advance(0.4)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.STATE_FROZEN])
    assert bench.out("state_is_known")[0] == 0
    bench.advance(2.2)
    np.testing.assert_array_equal(bench.out("velocity_setpoint")[:3], [0.0, 0.0, -0.5])


def test_a_vehicle_that_tips_over_is_levelled():
    """Beyond the greatest tilt the command turns the body back to level."""
    bench = Bench(flies=False)
    tilted = hover_state([10.0, 0.0, 3.0])
    tilted[6:10] = np.cos(0.6), np.sin(0.6), 0.0, 0.0  # 1.2 rad about x
    bench.advance(0.05)
    bench.give(state=tilted, measured_state=tilted)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.TILTED])
    assert bench.out("command")[1] < -3.0


def test_outside_the_fence_the_vehicle_is_led_back():
    """A vehicle that is outside is not flown by the policy until it is inside again."""
    config = replace(CONFIG, limits=FlightLimits(geofence=[[0.0, -5, 0], [9.5, 5, 6]]))
    bench = Bench(config)
    bench.advance(0.05)
    np.testing.assert_array_equal(bench.out("mode"), [status.HOLDING, status.OUTSIDE])
    bench.advance(1.9)
    assert bench.state()[0] < 9.6


def test_landing_is_let_down_on_what_is_level_and_on_nothing_else():
    """Above level ground the vehicle descends to it; above what is steep it keeps its distance."""
    for gradient, descends in (([0.0, 0.0, 1.0], True), ([0.8, 0.0, 0.6], False)):
        bench = Bench(flies=False)
        bench.advance(0.05)
        bench.give(observation_age=1.0, clearance=0.1, gradient=gradient)
        bench.advance(2.2)
        assert bench.out("mode")[0] == status.LANDING
        v = bench.out("velocity_setpoint")[:3]
        assert (v[2] == pytest.approx(-0.5)) == descends
        assert descends or v.dot(gradient) >= -1e-9


@pytest.mark.parametrize("name", ["max_age", "max_lag", "recovery", "patience", "descent"])
def test_bad_config_is_named(name):
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=rf"failsafe\.{name} is 0"):
        FailsafeConfig(**{name: 0.0}).validate()
