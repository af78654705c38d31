import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from splatpilot.systems.sensing.estimators import (
    InertialFilter,
    InertialFilterEstimator,
    MotionCapture,
    MotionCaptureEstimator,
    VisualInertial,
    VisualInertialEstimator,
    drift_step,
    stationary,
)
from splatpilot.systems.sensing.imu import ImuSensor, white_noise
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState

SPEED = np.array([1.5, -0.5, 0.25])  # [m/s]
NO_DRIFT = {"position_walk": 0.0, "yaw_walk": 0.0}
NO_NOISE = {"velocity_noise": 0.0, "direction_noise": 0.0, "height_noise": 0.0}


def estimates(estimator, rate: float, duration: float) -> tuple[np.ndarray, QuadrotorState]:
    """Returns times (N,) of samples of a flight at constant velocity, and the estimates."""
    builder = DiagramBuilder()
    start = hover_state([0.0, 0.0, 2.0], yaw=0.5) + np.r_[np.zeros(3), SPEED, np.zeros(7)]
    end = start + np.r_[100.0 * SPEED, np.zeros(10)]
    motion = PiecewisePolynomial.FirstOrderHold([0.0, 100.0], np.column_stack([start, end]))
    truth = builder.AddSystem(TrajectorySource(motion))
    builder.AddNamedSystem("estimator", estimator)
    builder.Connect(truth.get_output_port(), estimator.get_input_port())
    log = LogVectorOutput(estimator.get_output_port(), builder, 1.0 / rate)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    found = log.FindLog(simulator.get_context())
    return found.sample_times(), QuadrotorState.of(found.data().T)


def walk(config: VisualInertial, steps: int, velocity=(0.0, 0.0, 0.0), count: int = 4000):
    """Returns the errors (steps + 1, count, 9) before and after each of the steps."""
    random, all_errors = np.random.default_rng(3), []
    errors = np.zeros((count, 9))
    errors[:, 4:] = np.array(stationary(config)) * random.standard_normal((count, 5))
    v_WB = np.tile(velocity, (count, 1))
    for _ in range(steps + 1):
        all_errors.append(errors)
        jumps = random.random(count) < config.jump_rate / config.rate
        normal = random.standard_normal((12, count))
        errors = np.stack(drift_step(config, errors.T, v_WB.T, normal, jumps), axis=-1)
    return np.array(all_errors)


def test_position_and_yaw_drift_with_the_root_of_time():
    errors = walk(VisualInertial(rate=50.0, position_walk=0.02, yaw_walk=0.01), 250)
    for seconds in (1, 5):
        found = errors[50 * seconds]
        assert found[:, :3].std() == pytest.approx(0.02 * np.sqrt(seconds), rel=0.05)
        assert found[:, 3].std() == pytest.approx(0.01 * np.sqrt(seconds), rel=0.05)


def test_a_moving_vehicle_drifts_across_its_path_by_its_yaw_and_along_it_by_scale():
    config = VisualInertial(rate=50.0, position_walk=0.0, yaw_walk=0.01, scale_bias=0.02)
    errors = walk(config, 250, (2.0, 0.0, 0.0))[-1]
    # The integral of a Wiener process has the variance T^3 / 3.
    assert errors[:, 1].std() == pytest.approx(2.04 * 0.01 * np.sqrt(5.0**3 / 3.0), rel=0.05)
    assert errors[:, 0].mean() == pytest.approx(0.02 * 10.0, rel=0.05)


def test_errors_with_memory_keep_their_size_and_correlation():
    errors = walk(VisualInertial(rate=50.0, memory=0.4), 40)[..., 4:]
    for found in (errors[0], errors[40]):
        np.testing.assert_allclose(found.std(axis=0), [0.08, 0.08, 0.08, 0.05, 0.03], rtol=0.05)
    for steps in (10, 20, 40):
        correlation = np.mean(errors[0] * errors[steps]) / np.mean(errors[0] ** 2)
        assert correlation == pytest.approx(np.exp(-steps / 50.0 / 0.4), abs=0.05)


def test_jumps_come_at_their_rate_with_their_size():
    config = VisualInertial(rate=50.0, **NO_DRIFT, jump_rate=0.5, jump_size=0.2)
    errors = walk(config, 100)[-1]
    # Poisson: the variance after T is rate T size^2, and exp(-rate T) have not jumped.
    assert errors[:, :3].std() == pytest.approx(0.2, rel=0.05)
    assert np.mean(errors[:, 0] == 0.0) == pytest.approx(np.exp(-1.0), rel=0.05)


def test_estimates_are_held_and_late():
    config = VisualInertial(rate=20.0, latency=0.1, **NO_DRIFT, **NO_NOISE)
    times, seen = estimates(VisualInertialEstimator(config, 0), 20.0, 2.0)
    expected = np.array([0.0, 0.0, 2.0]) + np.maximum(times - 0.15, 0.0)[:, None] * SPEED
    np.testing.assert_allclose(seen.p_WB, expected, atol=1e-9)  # a log samples before updates
    np.testing.assert_allclose(seen.v_WB, np.tile(SPEED, (len(times), 1)), atol=1e-12)


def test_motion_capture_has_its_noise_and_follows_velocity():
    config = MotionCapture(dropout=0.0, latency=0.0, position_noise=1e-3, velocity_filter=0.09)
    times, seen = estimates(MotionCaptureEstimator(config, 4), config.rate, 30.0)
    np.testing.assert_allclose(seen.v_WB[0], SPEED)  # as at the start
    late = times > 1.0
    errors = (seen.p_WB - [0.0, 0.0, 2.0] - (times - 0.01)[:, None] * SPEED)[late]
    assert errors.std() == pytest.approx(1e-3, rel=0.05)
    # Differences of white positions through a first-order filter of gain k.
    k = 0.01 / (0.01 + 0.09)
    expected = 1e-3 / 0.01 * np.sqrt(2.0 * k**2 / (2.0 - k))
    errors = (seen.v_WB - SPEED)[late]
    assert errors.std() == pytest.approx(expected, rel=0.05)
    assert abs(errors.mean()) < 0.01


def test_estimates_follow_from_the_seed_and_lost_frames_keep_the_pose():
    def estimate(name: str, seed: int, duration: float = 0.5) -> QuadrotorState:
        system = {
            "visual": lambda: VisualInertialEstimator(VisualInertial(), seed),
            "capture": lambda: MotionCaptureEstimator(MotionCapture(dropout=0.3), seed),
        }[name]()
        return estimates(system, 100.0, duration)[1]

    for name in ("visual", "capture"):
        first, again, other = (estimate(name, seed).to_vector() for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert np.any(first != other)
    kept = np.all(np.diff(estimate("capture", 5, 20.0).p_WB, axis=0) == 0.0, axis=1)
    assert kept.mean() == pytest.approx(0.3, abs=0.03)


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
        under = self._block if 1.0 < context.get_time() < 2.0 else 0.0
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
    for seed in range(2):
        true, seen, sigma = flown(seed, 5.0)
        errors = [seen.p_WB[-1] - true.p_WB[-1], seen.v_WB[-1] - true.v_WB[-1]]
        ratios.append(np.concatenate(errors) / sigma[:6])
        assert np.abs(errors[1]).max() < 0.1
        assert abs(errors[0][2]) < 0.06  # height is measured
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_an_obstacle_below_does_not_change_the_height():
    true, seen, _ = flown(0, 2.2, block=1.0)
    assert np.abs(seen.p_WB - true.p_WB)[:, 2].max() < 0.1
    config = InertialFilter()
    config.height.direction = [1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"direction must be \[0.0, 0.0, -1.0\], got"):
        config.validate()
