import msgpack
import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from splatpilot.systems.policies.teleop import AXES, Teleop, TeleopConfig
from splatpilot.systems.vehicle.quadrotor import hover_state


@pytest.fixture
def flown():
    """A simulation of a vehicle that heads along y, with its policy."""
    policy = Teleop(TeleopConfig(speed=2.0, turn_rate=1.0, rate=10.0))
    simulator = Simulator(policy)
    context = simulator.get_mutable_context()
    policy.GetInputPort("state").FixValue(context, hover_state([0, 0, 1], yaw=np.pi / 2))
    policy.GetInputPort("goal").FixValue(context, np.zeros(3))
    return policy, simulator


def outputs(policy, simulator) -> tuple[np.ndarray, float]:
    context = simulator.get_context()
    velocity, heading = (policy.GetOutputPort(n).Eval(context) for n in ("velocity", "heading"))
    return velocity, heading[0]


def test_sliders_command_velocities_in_the_frame_of_the_heading(flown):
    policy, simulator = flown
    simulator.AdvanceTo(0.05)
    velocity, heading = outputs(policy, simulator)
    assert not velocity.any() and heading == pytest.approx(np.pi / 2)
    meshcat = Meshcat()
    policy.add_controls(meshcat)
    policy.add_controls(meshcat)  # A second flight of one Meshcat.
    names = {axis: name for axis, (name, *_) in AXES.items()}
    for axis, value in {"forward": 2.0, "left": 0.5, "up": -1.0}.items():
        meshcat.SetSliderValue(names[axis], value)
    simulator.AdvanceTo(0.15)
    np.testing.assert_allclose(outputs(policy, simulator)[0], [-0.5, 2.0, -1.0], atol=1e-12)
    meshcat.SetSliderValue(names["forward"], 0.0)
    meshcat.SetSliderValue(names["left"], 0.0)
    meshcat.SetSliderValue(names["turn"], 1.0)
    simulator.AdvanceTo(0.65)
    velocity, heading = outputs(policy, simulator)
    assert heading == pytest.approx(np.pi / 2 + 0.5)
    np.testing.assert_allclose(velocity, [0, 0, -1], atol=1e-12)
    click = {"type": "button", "name": "stop (x)", "value": 1}
    meshcat._InjectWebsocketMessage(msgpack.packb(click))
    simulator.AdvanceTo(0.75)
    np.testing.assert_allclose(outputs(policy, simulator)[0], 0, atol=1e-12)
    assert meshcat.GetSliderValue(names["turn"]) == 0.0


def test_gamepad_commands_velocities(flown):
    policy, simulator = flown
    meshcat = Meshcat()
    policy.add_controls(meshcat)
    pad = {"index": 0, "button_values": [], "axes": [0.05, -1.0, 0.0, 0.5]}
    meshcat._InjectWebsocketMessage(msgpack.packb({"type": "gamepad", "name": "", "gamepad": pad}))
    simulator.AdvanceTo(0.05)
    np.testing.assert_allclose(outputs(policy, simulator)[0], [0, 2, -1], atol=1e-12)
