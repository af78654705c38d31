import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.vehicle.quadrotor import hover_state


class Falling(LeafSystem):
    """The state of a vehicle that falls with 2 m/s^2 while it rotates about z at 1 rad/s."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context, output) -> None:
        output.set_value(self.state(context.get_time()))

    @staticmethod
    def state(time: float) -> np.ndarray:
        state = hover_state([3 * time, 0.0, 5.0 - time**2], yaw=time)
        state[3:6] = [3.0, 0.0, -2 * time]
        return state


@pytest.mark.parametrize("latency", [0.0, 0.02, 0.1, 0.133])
def test_delayed_pose_is_the_pose_then(latency):
    builder = DiagramBuilder()
    source = builder.AddSystem(Falling())
    delayed = builder.AddSystem(DelayedPose(FrameTimes.late(latency), period=0.02))
    builder.Connect(source.get_output_port(), delayed.GetInputPort("state"))
    simulator = Simulator(builder.Build())
    context = delayed.GetMyContextFromRoot(simulator.get_mutable_context())
    for now in (0.0, 0.01, 0.05, 0.2, 0.513, 1.0 / 3.0 + 0.5):
        simulator.AdvanceTo(now)
        X_WB = delayed.GetOutputPort("pose").Eval(context)
        expected = Falling.state(max(now - latency, 0.0))
        np.testing.assert_allclose(X_WB.translation(), expected[:3], atol=1.01e-4)
        q_WB = X_WB.rotation().ToQuaternion().wxyz()
        np.testing.assert_allclose(q_WB, expected[6:10], atol=2e-5)


def test_a_negative_latency_is_refused():
    with pytest.raises(ValueError, match=r"delays of frames must be .* got -0.1"):
        DelayedPose(FrameTimes.late(-0.1))
