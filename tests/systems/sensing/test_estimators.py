import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from splatpilot.systems.sensing.estimators import (
    MotionCapture,
    MotionCaptureEstimator,
    VisualInertial,
    VisualInertialEstimator,
    drift_step,
    stationary,
)
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState

SPEED = np.array([1.5, -0.5, 0.25])  # [m/s]
NO_DRIFT = {"position_walk": 0.0, "yaw_walk": 0.0}
NO_NOISE = {"velocity_noise": 0.0, "direction_noise": 0.0, "height_noise": 0.0}


class Straight(LeafSystem):
    """Outputs the state of a vehicle at constant velocity."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context, output) -> None:
        state = QuadrotorState.of(hover_state([0.0, 0.0, 2.0], yaw=0.5))
        p_WB = state.p_WB + context.get_time() * SPEED
        output.SetFromVector(state._replace(p_WB=p_WB, v_WB=SPEED).to_vector())


def estimates(estimator, rate: float, duration: float) -> tuple[np.ndarray, QuadrotorState]:
    """Returns times (N,) just after samples, and the estimates then (N, 13)."""
    builder = DiagramBuilder()
    truth = builder.AddSystem(Straight())
    builder.AddNamedSystem("estimator", estimator)
    builder.Connect(truth.get_output_port(), estimator.get_input_port())
    log = LogVectorOutput(estimator.get_output_port(), builder, 1.0 / rate)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    found = log.FindLog(simulator.get_context())
    return found.sample_times(), QuadrotorState.of(found.data().T)


def walk(config: VisualInertial, steps: int, velocity: np.ndarray, count: int = 4000):
    """Yields the errors (count, 9) after each of the steps."""
    random = np.random.default_rng(3)
    errors = np.zeros((count, 9))
    errors[:, 4:] = np.array(stationary(config)) * random.standard_normal((count, 5))
    v_WB = np.tile(velocity, (count, 1))
    for _ in range(steps):
        yield errors
        jumps = random.random(count) < config.jump_rate / config.rate
        normal = random.standard_normal((12, count))
        errors = np.stack(drift_step(config, errors.T, v_WB.T, normal, jumps), axis=-1)
    yield errors


def test_position_and_yaw_drift_with_the_root_of_time():
    config = VisualInertial(rate=50.0, position_walk=0.02, yaw_walk=0.01)
    errors = list(walk(config, 500, np.zeros(3)))
    for seconds in (1, 3, 10):
        found = errors[50 * seconds]
        assert found[:, :3].std() == pytest.approx(0.02 * np.sqrt(seconds), rel=0.05)
        assert found[:, 3].std() == pytest.approx(0.01 * np.sqrt(seconds), rel=0.05)


def test_a_moving_vehicle_drifts_across_its_path_by_its_yaw_and_along_it_by_scale():
    config = VisualInertial(rate=50.0, position_walk=0.0, yaw_walk=0.01, scale_bias=0.02)
    *_, errors = walk(config, 500, np.array([2.0, 0.0, 0.0]))
    # The integral of a Wiener process has the variance T^3 / 3.
    assert errors[:, 1].std() == pytest.approx(2.04 * 0.01 * np.sqrt(10.0**3 / 3.0), rel=0.05)
    assert errors[:, 0].mean() == pytest.approx(0.02 * 20.0, rel=0.05)


def test_errors_with_memory_keep_their_size_and_correlation():
    config = VisualInertial(rate=50.0, memory=0.4)
    errors = list(walk(config, 40, np.zeros(3)))
    sizes = [0.08, 0.08, 0.08, 0.05, 0.03]
    for found in (errors[0], errors[40]):
        np.testing.assert_allclose(found[:, 4:].std(axis=0), sizes, rtol=0.05)
    for steps in (10, 20, 40):
        correlation = np.mean(errors[0][:, 4:] * errors[steps][:, 4:]) / np.mean(
            errors[0][:, 4:] ** 2
        )
        assert correlation == pytest.approx(np.exp(-steps / 50.0 / 0.4), abs=0.05)


def test_jumps_come_at_their_rate_with_their_size():
    config = VisualInertial(rate=50.0, **NO_DRIFT, jump_rate=0.5, jump_size=0.2)
    *_, errors = walk(config, 100, np.zeros(3))
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
    late = times > 1.0
    errors = (seen.p_WB - [0.0, 0.0, 2.0] - (times - 0.01)[:, None] * SPEED)[late]
    assert errors.std() == pytest.approx(1e-3, rel=0.05)
    # Differences of white positions through a first-order filter of gain k.
    k = 0.01 / (0.01 + 0.09)
    expected = 1e-3 / 0.01 * np.sqrt(2.0 * k**2 / (2.0 - k))
    errors = (seen.v_WB - SPEED)[late]
    assert errors.std() == pytest.approx(expected, rel=0.05)
    assert abs(errors.mean()) < 0.01


def test_lost_frames_keep_the_pose():
    config = MotionCapture(dropout=0.3)
    _, seen = estimates(MotionCaptureEstimator(config, 5), config.rate, 20.0)
    kept = np.all(np.diff(seen.p_WB, axis=0) == 0.0, axis=1)
    assert kept.mean() == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize(
    "make",
    [
        lambda seed: VisualInertialEstimator(VisualInertial(), seed),
        lambda seed: MotionCaptureEstimator(MotionCapture(), seed),
    ],
)
def test_estimates_follow_from_the_seed(make):
    first, again, other = (estimates(make(seed), 50.0, 0.5)[1].to_vector() for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
