"""State estimates: of motion capture, of visual-inertial odometry, and of a Kalman filter.

Estimators sample at their rate, and hold the estimate in between. Random numbers follow from the
seed, the system's name and the sample's number.
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from splatpilot.systems.common.drake import vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.imu import Imu, RangeFinder, white_noise
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, array_namespace


@dataclass
class TrueState(Config):
    """The exact state, without delay."""


@dataclass
class MotionCapture(Config):
    """Poses of a motion capture system, and a gyroscope, see `MotionCaptureEstimator`.

    The defaults are our choice, for a room with calibrated cameras and a radio link.
    """

    # [Hz] Frames per second.
    rate: float = bounded(100.0, "[1, 1000] Hz")
    # [s] Age of the estimate, rounded up to whole frames.
    latency: float = bounded(0.01, "[0, 1] s")
    # [m] Standard deviation of positions.
    position_noise: float = bounded(2e-4, "[0, 1] m")
    # [rad] Standard deviation of rotations about each axis.
    rotation_noise: float = bounded(2e-3, "[0, 1] rad")
    # [rad/s] Standard deviation of body rates, which a gyroscope measures.
    rate_noise: float = bounded(3e-3, "[0, inf) rad/s")
    # [-] Probability that a frame is lost.
    dropout: float = bounded(0.01, "[0, 1)")
    # [s] Time constant of the filter of velocities, which are differences of positions.
    velocity_filter: float = bounded(0.03, "[0, 1] s")


@dataclass
class VisualInertial(Config):
    """The drift of visual-inertial odometry and errors with memory, see `drifting_state`.

    Errors of velocity, direction and height are those of the training of "Flying in Clutter on
    Monocular RGB" (arXiv 2512.17349). Drift, jumps and memory are our choice: about 0.1 m and 1 deg
    after 80 s.
    """

    # [Hz] Estimates per second.
    rate: float = bounded(50.0, "[1, 1000] Hz")
    # [s] Age of position and velocity, rounded up to whole samples; attitude and body rates follow
    # the IMU.
    latency: float = bounded(0.0, "[0, 1] s")
    # [m/sqrt(s)] Random walk of the position along each axis.
    position_walk: float = bounded(0.01, "[0, 10] m/sqrt(s)")
    # [rad/sqrt(s)] Random walk of the yaw.
    yaw_walk: float = bounded(0.002, "[0, 1] rad/sqrt(s)")
    # [-] Bias of the scale of velocities and distances.
    scale_bias: float = bounded(0.0, "[-0.5, 0.5]")
    # [Hz] Mean number of jumps per second.
    jump_rate: float = bounded(0.0, "[0, 10] Hz")
    # [m] Standard deviation of a jump along each axis.
    jump_size: float = bounded(0.1, "[0, 10] m")
    # [m/s] Standard deviation of the velocity along each axis.
    velocity_noise: float = bounded(0.08, "[0, 10] m/s")
    # [rad] Standard deviation of the yaw, and so of directions.
    direction_noise: float = bounded(0.05, "[0, 1] rad")
    # [m] Standard deviation of the height.
    height_noise: float = bounded(0.03, "[0, 10] m")
    # [s] Correlation time of these three errors.
    memory: float = bounded(0.5, "(0, 100] s")


def drift_step(config: VisualInertial, errors: Any, v_WB: Any, normal: Any, jumps: Any) -> list:
    """Returns the components (9) of the errors of the next sample: floats, arrays or tensors.

    They are those of the position (3) and yaw (1), which add up, and of velocity (3), direction (1)
    and height (1), which are Ornstein-Uhlenbeck processes: with a = exp(-T / memory),

        x' = a x + sigma sqrt(1 - a^2) n.

    Args:
        errors: components (9).
        v_WB: components (3) [m/s].
        normal: components (12), drawn from N(0, 1).
        jumps: 1 with the probability `jump_rate` / `rate`, else 0.
    """
    period = 1.0 / config.rate
    root, keep = math.sqrt(period), math.exp(-period / config.memory)
    drifted = _drifted_velocity(config, errors[3], v_WB)
    walk, jump = root * config.position_walk, config.jump_size * jumps
    position = [
        errors[k] + period * (drifted[k] - v_WB[k]) + walk * normal[k] + jump * normal[9 + k]
        for k in range(3)
    ]
    fresh, sigmas = math.sqrt(1.0 - keep**2), stationary(config)
    rest = [keep * errors[k] + fresh * sigmas[k - 4] * normal[k] for k in range(4, 9)]
    return [*position, errors[3] + root * config.yaw_walk * normal[3], *rest]


def stationary(config: VisualInertial) -> list[float]:
    """Returns the standard deviations (5) of velocity, direction and height."""
    return [*[config.velocity_noise] * 3, config.direction_noise, config.height_noise]


def _drifted_velocity(config: VisualInertial, yaw: Any, v_WB: Any) -> tuple[Any, Any, Any]:
    """Returns the components (3) of the velocity with an error of yaw [rad] and the scale."""
    xp, (x, y, z) = math if isinstance(yaw, float) else array_namespace(yaw), v_WB
    scale = 1.0 + config.scale_bias
    cos, sin = scale * xp.cos(yaw), scale * xp.sin(yaw)
    return cos * x - sin * y, sin * x + cos * y, scale * z


def drifting_state(config: VisualInertial, state: np.ndarray, errors: Any) -> np.ndarray:
    """Returns the estimate (13,) of a state (13,) with the errors (9) of `drift_step`."""
    px, py, pz, vx, vy, vz, w, x, y, z, *w_WB_B = state.tolist()
    drifted = _drifted_velocity(config, errors[3], (vx, vy, vz))
    half = 0.5 * (errors[3] + errors[7])
    cos, sin = math.cos(half), math.sin(half)
    return np.array(
        [
            *(px + errors[0], py + errors[1], pz + errors[2] + errors[8]),
            *(v + error for v, error in zip(drifted, errors[4:7], strict=True)),
            *(cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w),
            *w_WB_B,
        ]
    )


class _Estimator(LeafSystem):
    """Base of estimators that sample the true ``state`` (13) and output another, late.

    The discrete state has the current estimate, later ones in order, and the memory.
    """

    def __init__(self, config: Any, seed: int, size: int) -> None:
        super().__init__()
        config.validate()
        self._config, self._seed = config, seed
        self._late = math.ceil(config.latency * config.rate - 1e-9)
        self.DeclareVectorInputPort("state", 13)
        hover = hover_state([0.0, 0.0, 0.0])
        self.DeclareStateOutputPort("state", self.DeclareDiscreteState(hover))
        self.DeclareDiscreteState(np.tile(hover, self._late))
        self.DeclareDiscreteState(size)
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._sample)

    draws: ClassVar[int]
    """Number of draws from N(0, 1) for each sample."""
    num_late: ClassVar[int] = 13
    """Number of entries of the state, from the first, that are as old as the latency."""

    def first(self, state: np.ndarray) -> np.ndarray:
        """Returns the memory at time 0."""
        raise NotImplementedError

    def estimate(
        self, state: np.ndarray, memory: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the estimate (13,) of a state (13,) and the next memory."""
        raise NotImplementedError

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = vector_input(self, "state", context)
        discrete_state.set_value(0, state)
        discrete_state.set_value(1, np.tile(state, self._late))
        discrete_state.set_value(2, self.first(state))

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        old = context.get_discrete_state()
        rate, time = self._config.rate, context.get_time()
        normal = white_noise(self, self._seed, time, rate, self.draws)
        state, memory = vector_input(self, "state", context), np.array(old.value(2))
        estimate, memory = self.estimate(state, memory, normal)
        queue = np.concatenate([old.value(1), estimate])
        late, current = queue[: self.num_late], estimate[self.num_late :]
        discrete_state.set_value(0, np.concatenate([late, current]))
        discrete_state.set_value(1, queue[13:])
        discrete_state.set_value(2, memory)


class VisualInertialEstimator(_Estimator):
    """Estimates the state with drift and noise, see `drifting_state`.

    .. pydrake_system::

        name: VisualInertialEstimator
        input_ports: [state]
        output_ports: [state]

    ``state`` (13): the true one, and the estimate.
    """

    draws = 13
    num_late = 6

    def __init__(self, config: VisualInertial, seed: int) -> None:
        super().__init__(config, seed, 9)

    def first(self, state: np.ndarray) -> np.ndarray:
        random = np.random.default_rng([self._seed, 0])
        return np.append(np.zeros(4), stationary(self._config) * random.standard_normal(5))

    def estimate(
        self, state: np.ndarray, memory: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        config, errors, draws = self._config, memory.tolist(), normal.tolist()
        jumps = float(ndtr(draws[12]) < config.jump_rate / config.rate)
        following = drift_step(config, errors, state[3:6].tolist(), draws, jumps)
        return drifting_state(config, state, errors), np.array(following)


class MotionCaptureEstimator(_Estimator):
    """Estimates the state from noisy poses, with lost frames, and noisy body rates.

    .. pydrake_system::

        name: MotionCaptureEstimator
        input_ports: [state]
        output_ports: [state]

    ``state`` (13): the true one, and the estimate. Its velocity follows the differences of received
    positions with the time constant `velocity_filter`; while frames are lost, it is that of the
    last one.
    """

    draws = 10

    def __init__(self, config: MotionCapture, seed: int) -> None:
        super().__init__(config, seed, 14)

    def first(self, state: np.ndarray) -> np.ndarray:
        return np.append(state, 0.0)  # the last estimate, and its age in frames

    def estimate(
        self, state: np.ndarray, memory: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        config, lost, normal = self._config, ndtr(normal[9]), normal[:9].reshape(3, 3)
        last, missed = QuadrotorState.of(memory[:13]), memory[13]
        true = QuadrotorState.of(state)
        w_WB_B = true.w_WB_B + config.rate_noise * normal[2]
        if lost < config.dropout:
            kept = last._replace(w_WB_B=w_WB_B).to_vector()
            return kept, np.append(kept, missed + 1.0)
        p_WB = true.p_WB + config.position_noise * normal[0]
        turn = Rotation.from_rotvec(config.rotation_noise * normal[1])
        q_WB = Rotation.from_quat(true.q_WB, scalar_first=True) * turn
        v_WB, duration = last.v_WB, missed / config.rate
        if duration > 0.0:
            follow = duration / (duration + config.velocity_filter)
            v_WB = v_WB + follow * ((p_WB - last.p_WB) / duration - v_WB)
        q = q_WB.as_quat(scalar_first=True)
        measured = QuadrotorState(p_WB, v_WB, q, w_WB_B).to_vector()
        return measured, np.append(measured, 1.0)


_DOWN = [0.0, 0.0, -1.0]
_UNKNOWN_GROUND = 10.0  # [m] standard deviation of its height before the first measurement


@dataclass
class InertialFilter(Config):
    """An extended Kalman filter, see `InertialFilterEstimator`, with sensors of its own."""

    # Its rate is that of the filter.
    imu: Imu = field(default_factory=Imu)
    # Looks down.
    height: RangeFinder = field(default_factory=RangeFinder)
    # [m/s^2] Standard deviation of drag, as wind changes it; horizontal velocity follows from drag.
    drag_noise: float = bounded(0.1, "(0, inf) m/s^2")
    # [-] Measurements are left out beyond this multiple of their standard deviation, as heights
    # above obstacles are.
    gate: float = bounded(4.0, "(0, inf)")

    def check(self) -> None:
        require_field(self.height, "direction", self.height.direction == _DOWN, str(_DOWN))

    @property
    def rate(self) -> float:
        """[Hz]"""
        return self.imu.rate

    @property
    def sensors(self) -> dict[str, Any]:
        """Sensors of the flight, by name."""
        return {"filter_imu": self.imu, "filter_height": self.height}


def skew(v: np.ndarray) -> np.ndarray:
    """Returns the matrix (3, 3) of the cross product with v (3,)."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class InertialFilterEstimator(LeafSystem):
    """Estimates the state by an error-state extended Kalman filter (Sola, arXiv 1711.02508).

    .. pydrake_system::

        name: InertialFilterEstimator
        input_ports: [state, filter_imu_accelerometer, filter_imu_gyroscope, filter_height_range]
        output_ports: [state]

    The estimate begins at the true ``state`` (13), which is read at time 0 only. Each sample of the
    IMU advances it. Each sample of the range finder corrects it by the height above the ground of
    the start, and by the accelerations along the body's x and y axes, which are drag: a = -drag v
    (Leishman et al., "Quadrotors and accelerometers", IEEE Control Systems 2014). Position along
    the ground and yaw drift, since no sensor measures them.

    Discrete state: the estimate (13); biases of accelerometer and gyroscope and the height of the
    ground (7); their covariance (16, 16) with position, velocity and rotation in B.
    """

    def __init__(self, config: InertialFilter, params: QuadrotorParams) -> None:
        super().__init__()
        config.validate()
        self._config, self._params = config, params
        self._every = max(1, round(config.imu.rate / config.height.rate))
        self.DeclareVectorInputPort("state", 13)
        for name, size in (("imu_accelerometer", 3), ("imu_gyroscope", 3), ("height_range", 1)):
            self.DeclareVectorInputPort(f"filter_{name}", size)
        group = self.DeclareDiscreteState(hover_state([0.0, 0.0, 0.0]))
        self.DeclareStateOutputPort("state", group)
        for size in (7, 256):
            self.DeclareDiscreteState(size)
        imu = config.imu
        self._noise = np.zeros(16)
        for k, density in (
            (3, imu.accelerometer_noise),
            (6, imu.gyroscope_noise),
            (9, imu.accelerometer_walk),
            (12, imu.gyroscope_walk),
        ):
            self._noise[k : k + 3] = density**2 / imu.rate
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / imu.rate, 0.0, self._step)

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = vector_input(self, "state", context)
        height = vector_input(self, "filter_height_range", context)[0]
        # As of a vehicle that stood still: millimeters and milliradians.
        variances, biases = np.full(16, 1e-6), np.append(np.zeros(6), state[2])
        variances[15] = _UNKNOWN_GROUND**2
        if np.isfinite(height):
            biases[6], variances[15] = state[2] - height, self._config.height.noise**2
        for group, values in enumerate((state, biases, np.diag(variances).ravel())):
            discrete_state.set_value(group, values)

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        number = round(context.get_time() * self._config.imu.rate)
        if number == 0:  # The IMU has no sample yet.
            return
        old = context.get_discrete_state()
        x, bias, P = (np.array(old.value(k)) for k in range(3))
        P = P.reshape(16, 16)
        force = vector_input(self, "filter_imu_accelerometer", context) - bias[:3]
        rates = vector_input(self, "filter_imu_gyroscope", context) - bias[3:6]
        x, P = self._predict(x, P, force, rates)
        if number % self._every == 0:
            reading = vector_input(self, "filter_height_range", context)[0]
            x, bias, P = self._correct(x, bias, P, force, reading)
        x[10:] = vector_input(self, "filter_imu_gyroscope", context) - bias[3:6]
        for group, values in enumerate((x, bias, P.ravel())):
            discrete_state.set_value(group, values)

    def _predict(
        self, x: np.ndarray, P: np.ndarray, force: np.ndarray, rates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advances the estimate by a sample of specific force [m/s^2] and body rates [rad/s]."""
        T = 1.0 / self._config.imu.rate
        p, v, q, _ = QuadrotorState.of(x)
        attitude = Rotation.from_quat(q, scalar_first=True)
        R = attitude.as_matrix()
        turn = Rotation.from_rotvec(T * rates)
        a = (attitude * Rotation.from_rotvec(0.5 * T * rates)).apply(force)
        a[2] -= self._params.gravity
        F = np.eye(16)
        F[0:3, 3:6] = T * np.eye(3)
        F[3:6, 6:9], F[3:6, 9:12] = -T * R @ skew(force), -T * R
        F[6:9, 6:9], F[6:9, 12:15] = turn.as_matrix().T, -T * np.eye(3)
        P = F @ P @ F.T
        P[np.diag_indices(16)] += self._noise
        q = (attitude * turn).as_quat(scalar_first=True)
        return QuadrotorState(p + T * v + 0.5 * T * T * a, v + T * a, q, rates).to_vector(), P

    def _correct(
        self,
        x: np.ndarray,
        bias: np.ndarray,
        P: np.ndarray,
        force: np.ndarray,
        reading: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corrects the estimate by drag, and by the reading [m] of the range finder if finite."""
        config, drag = self._config, self._params.drag
        p, v, q, w = QuadrotorState.of(x)
        R = Rotation.from_quat(q, scalar_first=True).as_matrix()
        v_B = R.T @ v
        H, residual, variance = np.zeros((3, 16)), np.zeros(3), np.zeros(3)
        H[:2, 3:6], H[:2, 6:9] = -drag * R.T[:2], -drag * skew(v_B)[:2]
        H[:2, 9:12] = np.eye(3)[:2]
        residual[:2] = force[:2] + drag * v_B[:2]
        white = config.imu.accelerometer_noise**2 * config.imu.rate
        variance[:2] = config.drag_noise**2 + white
        H[2, [2, 15]], residual[2] = (1.0, -1.0), reading * R[2, 2] + bias[6] - p[2]
        variance[2] = config.height.noise**2 + 1e-6
        error = np.zeros(16)
        for h, measured, r in zip(H, residual, variance, strict=True):
            innovation, S = measured - h @ error, h @ P @ h + r
            if not innovation**2 <= config.gate**2 * S:  # also of infinite ranges
                continue
            K = P @ h / S
            error += K * innovation
            P = P - np.outer(K, h @ P)
        turn = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(error[6:9])
        q = turn.as_quat(scalar_first=True)
        x = QuadrotorState(p + error[:3], v + error[3:6], q, w).to_vector()
        return x, bias + error[9:], 0.5 * (P + P.T)
