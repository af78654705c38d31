import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from splatpilot.systems.sensing.estimators import InertialFilter, InertialFilterEstimator
from splatpilot.systems.sensing.imu import ImuSensor, white_noise
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState

PARAMS = QuadrotorParams()


class Course(LeafSystem):
    """Outputs a waypoint that circles and rises and falls, and the height above the ground."""

    def __init__(self, block: float) -> None:
        super().__init__()
        self._block = block
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort("waypoint", 3, self._waypoint, {self.time_ticket()})
        self.DeclareVectorOutputPort("range", 1, self._range)

    def _waypoint(self, context, output) -> None:
        phase = 0.8 * context.get_time()
        at = 3.0 * np.sin(phase), 3.0 - 3.0 * np.cos(phase), 2.0 + 0.3 * np.sin(2.0 * phase)
        output.SetFromVector(at)

    def _range(self, context, output) -> None:
        state = QuadrotorState.of(np.asarray(self.get_input_port().Eval(context)))
        [noise] = white_noise(self, 0, context.get_time(), 50.0, 1)
        under = self._block if 4.0 < context.get_time() < 5.0 else 0.0
        height = (state.p_WB[2] - under) / np.cos(state.tilt)
        output.SetFromVector([height + 0.02 * noise])


def flown(seed: int, duration: float, block: float = 0.0):
    """Returns times, true and estimated states, and standard deviations (16,)."""
    config = InertialFilter(drag_noise=0.02)
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant(PARAMS, hover_state([0.0, 0.0, 2.0])))
    controller = builder.AddSystem(FlatnessController(params=PARAMS))
    course = builder.AddSystem(Course(block))
    imu = builder.AddNamedSystem("imu", ImuSensor(config.imu, PARAMS, seed))
    estimator = builder.AddSystem(InertialFilterEstimator(config, PARAMS))
    state, command = plant.GetOutputPort("state"), controller.GetOutputPort("command")
    for system in (controller, course, imu, estimator):
        builder.Connect(state, system.GetInputPort("state"))
    for system in (plant, imu):
        builder.Connect(command, system.GetInputPort("command"))
    builder.Connect(course.GetOutputPort("waypoint"), controller.GetInputPort("waypoint"))
    for name in ("accelerometer", "gyroscope"):
        builder.Connect(imu.GetOutputPort(name), estimator.GetInputPort(f"filter_imu_{name}"))
    builder.Connect(course.GetOutputPort("range"), estimator.GetInputPort("filter_height_range"))
    logs = [LogVectorOutput(port, builder, 0.1) for port in (state, estimator.get_output_port())]
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    simulator.AdvanceTo(duration)
    P = estimator.GetMyContextFromRoot(context).get_discrete_state(2).value().reshape(16, 16)
    found = [QuadrotorState.of(log.FindLog(context).data().T) for log in logs]
    return *found, np.sqrt(np.diag(P))


def test_errors_are_those_that_the_covariance_states():
    ratios = []
    for seed in range(4):
        true, seen, sigma = flown(seed, 10.0)
        errors = [seen.p_WB[-1] - true.p_WB[-1], seen.v_WB[-1] - true.v_WB[-1]]
        ratios.append(np.concatenate(errors) / sigma[:6])
        assert np.abs(errors[1]).max() < 0.1
        assert abs(errors[0][2]) < 0.06  # height is measured
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_an_obstacle_below_does_not_change_the_height():
    true, seen, _ = flown(0, 6.0, block=1.0)
    assert np.abs(seen.p_WB - true.p_WB)[:, 2].max() < 0.1


def test_its_range_finder_looks_down():
    config = InertialFilter()
    config.height.direction = [1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"direction must be \[0.0, 0.0, -1.0\], got"):
        config.validate()
