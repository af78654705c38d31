"""A Kalman filter of an IMU and a range finder: the reference of state estimators."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.drake import vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.imu import Imu
from splatpilot.systems.sensing.range_finder import RangeFinder
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState

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
