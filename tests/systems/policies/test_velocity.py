import numpy as np
import pytest

from splatpilot.systems.messaging.failsafe import FiniteVector
from splatpilot.systems.policies.velocity import (
    RESPONSE_TIME,
    VelocitySetpoint,
    VelocityTracker,
    tracking_acceleration,
)
from splatpilot.systems.vehicle.flatness import FlatnessController, FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from tests.systems.vehicle.responses import evaluate


def test_tracking_is_exponential_and_limited():
    v, desired, step = np.zeros(3), np.array([0.5, 0.0, 0.2]), 1e-4
    for _ in range(round(RESPONSE_TIME / step)):
        v = v + step * tracking_acceleration(v, desired)
    np.testing.assert_allclose(v, desired * (1 - np.exp(-1)), rtol=1e-3)
    state = [9, 9, 9, 1, 0, -1, 1, 0, 0, 0, 0, 0, 0]
    found = evaluate(VelocityTracker(), state=state, velocity=[1, 0, 7])
    np.testing.assert_allclose(found, [0, 0, 6])


CONTROLLER = FlatnessControllerConfig(lookahead=0.5)
STATE = np.array([1.0, 2, 3, 0.5, -0.5, 0.2, 1, 0, 0, 0, 0, 0, 0])


def setpoint(**inputs) -> np.ndarray:
    return evaluate(VelocitySetpoint(CONTROLLER), **{"state": STATE} | inputs)


def test_setpoints_lead_to_the_decision():
    desired = np.array([1.5, 0.5, -0.3])
    acceleration = tracking_acceleration(STATE[3:6], desired)
    np.testing.assert_allclose(setpoint(acceleration=acceleration)[:3], desired)
    np.testing.assert_array_equal(setpoint(velocity=np.array([1.0, -2, 3]))[:3], [1, -2, 3])
    found = setpoint(waypoint=np.array([2.0, 2, 2]), heading=np.array([0.7]))
    np.testing.assert_allclose(found, [2.0, 0.0, -2.0, 0.7])


@pytest.mark.parametrize("speed", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("decision", ["waypoint", "acceleration"])
@pytest.mark.parametrize("heading", [{}, {"heading": np.array([np.nan])}])
def test_without_a_heading_the_turn_is_that_of_the_controller(decision, speed, heading):
    state = hover_state([1.0, 2.0, 3.0], yaw=3.0)
    state[3:5] = speed * np.cos(-2.8), speed * np.sin(-2.8)
    inputs = {
        "waypoint": state[:3] + CONTROLLER.lookahead * state[3:6],
        "acceleration": np.zeros(3),
    }
    found = setpoint(state=state, **{decision: inputs[decision]}, **heading)
    controller = FlatnessController(CONTROLLER, QuadrotorParams(drag=0.0))
    context = controller.CreateDefaultContext()
    for name, value in {"state": state, decision: inputs[decision]}.items():
        controller.GetInputPort(name).FixValue(context, value)
    command = controller.EvalUniquePeriodicDiscreteUpdate(context).value(0)
    assert CONTROLLER.yaw_gain * (found[3] - 3.0) == pytest.approx(command[3], abs=1e-9)
    assert command[3] == pytest.approx(3.0 * (2 * np.pi - 5.8) * min(1.0, speed / 0.5) ** 2)


@pytest.mark.parametrize(
    ("kind", "arguments", "inputs"),
    [
        (VelocityTracker, (), {"state": STATE, "velocity": np.ones(3)}),
        (VelocitySetpoint, (CONTROLLER,), {"state": STATE, "velocity": np.ones(3)}),
        (FiniteVector, (3,), {"signal": np.ones(3)}),
    ],
)
def test_outputs_are_not_computed_again_as_time_moves(kind, arguments, inputs):
    class Counting(kind):
        calls = 0

        def _calc(self, context, output):
            self.calls += 1
            super()._calc(context, output)

    system = Counting(*arguments)
    context = system.CreateDefaultContext()
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    for time in (0.0, 1.0, 2.0):
        context.SetTime(time)
        system.get_output_port().Eval(context)
    assert system.calls == 1
