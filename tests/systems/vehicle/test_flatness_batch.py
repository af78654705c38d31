"""The controller's law for many vehicles, against the controller that flies one."""

import numpy as np
import pytest
import torch
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.vehicle.flatness import (
    FlatnessController,
    FlatnessControllerConfig,
    attitudes_from_thrust,
    flatness_commands,
    lengths,
    rotation_matrices,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from splatpilot.systems.vehicle.state import pose_from_state

CONTROL = FlatnessControllerConfig()
KINDS = pytest.mark.parametrize("make", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])


def some_states(count: int) -> np.ndarray:
    """States (count, 13) in motion, tilted by up to a radian or so."""
    rng = np.random.default_rng(3)
    states = np.stack([hover_state(rng.normal(size=3), yaw) for yaw in rng.uniform(-3, 3, count)])
    states[:, 3:] += 0.4 * rng.normal(size=(count, 10))
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    return states


@KINDS
def test_attitude_carries_the_thrust_and_the_yaw(make):
    """z lies along the thrust, and x seen from above along the yaw."""
    f, yaw = np.array([[2.0, -3.0, 9.0]]), np.array([0.7])
    R = np.asarray(attitudes_from_thrust(make(f), make(yaw)))[0]
    np.testing.assert_allclose(R[:, 2], f[0] / np.linalg.norm(f), atol=1e-12)
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.7)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


@KINDS
def test_rotations_are_those_of_the_quaternions(make):
    """As Drake has them, whatever the quaternion's length."""
    states = some_states(6)
    expected = [pose_from_state(state).rotation().matrix() for state in states]
    np.testing.assert_allclose(rotation_matrices(make(3.0 * states[:, 6:10])), expected, atol=1e-12)


def controller_command(state: np.ndarray, a_WB: np.ndarray, heading: float | None) -> np.ndarray:
    builder = DiagramBuilder()
    controller = builder.AddSystem(FlatnessController())
    values = {"state": state, "acceleration": a_WB}
    if heading is not None:
        values["heading"] = np.array([heading])
    for name, value in values.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), controller.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.001)
    context = controller.GetMyContextFromRoot(simulator.get_context())
    return np.array(controller.GetOutputPort("command").Eval(context))


@KINDS
@pytest.mark.parametrize("heading", [None, 0.4])
def test_commands_are_the_controllers(make, heading):
    """Thrusts and rates equal `FlatnessController`'s, for accelerations within its limits and
    far beyond them."""
    states = some_states(8)
    a_WB = np.random.default_rng(4).normal(size=(8, 3)) * np.repeat([1.0, 20.0], 4)[:, None]
    expected = [
        controller_command(state, a, heading) for state, a in zip(states, a_WB, strict=True)
    ]
    headings = None if heading is None else make(np.full(8, heading))
    found = flatness_commands(make(states), make(a_WB), CONTROL, QuadrotorParams(), headings)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_gradients_at_rest_are_finite():
    """A vehicle that hovers and is to go on hovering has no direction, and a gradient all the
    same."""
    state = torch.as_tensor(hover_state([0.0, 0.0, 2.0]))[None].requires_grad_()
    a_WB = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    flatness_commands(state, a_WB, CONTROL, QuadrotorParams()).sum().backward()
    assert state.grad is not None and a_WB.grad is not None
    assert torch.isfinite(state.grad).all() and torch.isfinite(a_WB.grad).all()
    nothing = torch.zeros(2, 3, requires_grad=True)
    lengths(nothing).sum().backward()
    assert nothing.grad is not None and (nothing.grad == 0).all()
