import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from splatpilot.systems.sensing.latency import CYCLE, DecisionDelay, DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import hover_state


class Falling(LeafSystem):
    """The state of a vehicle that falls with 2 m/s^2 while it rotates about z at 1 rad/s."""

    def __init__(self):
        super().__init__()
        calc = lambda context, output: output.set_value(self.state(context.get_time()))  # noqa: E731
        self.DeclareVectorOutputPort("state", 13, calc)

    @staticmethod
    def state(time: float) -> np.ndarray:
        state = hover_state([3 * time, 0.0, 5.0 - time**2], yaw=time)
        state[3:6] = [3.0, 0.0, -2 * time]
        return state


@pytest.mark.parametrize("latency", [0.0, 0.02, 0.133])
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


class Counter(LeafSystem):
    """Decides the number of its update."""

    def __init__(self, period: float) -> None:
        super().__init__()
        self.DeclareStateOutputPort("velocity", self.DeclareDiscreteState(np.array([-1.0])))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context, discrete_state) -> None:
        discrete_state.set_value(context.get_discrete_state_vector().value() + 1.0)


def test_a_frame_keeps_its_number_until_the_next_comes():
    frames = FrameTimes(np.full(CYCLE, 0.01), rate=10.0, phase=0.25, lookback=3)
    times = [0.036, 0.1, 0.134, 0.136, 0.2, 0.236]  # Frames come at 0.035, 0.135 and 0.235 s.
    numbers = [frames.number(time) for time in times]
    assert numbers == [CYCLE + k for k in (0, 0, 0, 1, 1, 2)]
    assert FrameTimes.late(0.1).number(1.0) is None
    slow = FrameTimes.draw(ObservationNoise(latency=0.5, frame_rate=[200.0, 200.0]), 1)
    assert (slow.number(0.0) or -1) > 0


@pytest.mark.parametrize("delay", [(0.0, 0.08), (0.03, 0.03), (0.09, 0.09)])
def test_decisions_come_when_their_delay_is_over(delay):
    builder, period = DiagramBuilder(), 0.05
    policy = builder.AddSystem(Counter(period))
    late = builder.AddSystem(DecisionDelay("velocity", 1, period, delay, 0.001, 3))
    builder.Connect(policy.get_output_port(), late.get_input_port())
    simulator = Simulator(builder.Build())
    port, context = late.get_output_port(), late.GetMyContextFromRoot(simulator.get_context())
    steps = np.arange(1, 2000) * 1e-3 + 5e-4
    found = []
    for time in steps:
        simulator.AdvanceTo(time)
        found.append(port.Eval(context)[0])
    first = [steps[np.array(found) >= k][0] - k * period for k in range(35)]
    assert min(first) >= delay[0] - 1e-3 and max(first) <= delay[1] + 1e-3
    if delay[0] < delay[1]:
        assert np.std(first) > 0.015
