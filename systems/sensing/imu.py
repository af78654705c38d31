"""An inertial measurement unit with noise and drifting biases, and a range finder along a ray."""

import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from splatpilot.systems.collision.distance_field import DistanceField, Distances
from splatpilot.systems.common.drake import optional_input, vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, quadrotor_derivatives
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

_BLOCK = 64  # samples whose noise is drawn at once: a generator costs more than its numbers


@dataclass
class Imu(Config):
    """An IMU at the origin of the body, with its axes; see `ImuSensor`.

    Its outputs are ``accelerometer`` (3) [m/s^2] and ``gyroscope`` (3) [rad/s]. The defaults are
    those of the ADIS16448 in the EuRoC data sets.
    """

    # [Hz] Measurements per second.
    rate: float = bounded(200.0, "(0, 1000] Hz")
    # [m/s^2/sqrt(Hz)] White noise of the accelerometer.
    accelerometer_noise: float = bounded(2.0e-3, "[0, inf) m/s^2/sqrt(Hz)")
    # [rad/s/sqrt(Hz)] White noise of the gyroscope.
    gyroscope_noise: float = bounded(1.6968e-4, "[0, inf) rad/s/sqrt(Hz)")
    # [m/s^3/sqrt(Hz)] Random walk of the accelerometer's bias.
    accelerometer_walk: float = bounded(3.0e-3, "[0, inf) m/s^3/sqrt(Hz)")
    # [rad/s^2/sqrt(Hz)] Random walk of the gyroscope's bias.
    gyroscope_walk: float = bounded(1.9393e-5, "[0, inf) rad/s^2/sqrt(Hz)")


def specific_force(state: np.ndarray, a_WB: np.ndarray, gravity: float) -> np.ndarray:
    """Computes f_B = R_BW (a_WB + g e_z) (3,) [m/s^2], of a state (13,) and acceleration (3,)."""
    f_W = a_WB + np.array([0.0, 0.0, gravity])
    return pose_from_state(state).rotation().inverse().multiply(f_W)


def measurement_error(
    bias: np.ndarray, white: Any, step: Any, noise: Any, walk: Any, rate: float
) -> tuple[Any, Any]:
    """Returns the error of sample k and the next bias, see `ImuSensor`."""
    return bias + noise * np.sqrt(rate) * white, bias + walk / np.sqrt(rate) * step


class ImuSensor(LeafSystem):
    """Measures specific force and body rates.

    .. pydrake_system::

        name: ImuSensor
        input_ports: [state, command, acceleration]
        output_ports: [accelerometer, gyroscope]

    - ``state`` (13), ``command`` (4): those of `QuadrotorPlant`.
    - ``acceleration`` (3), optional: a_WB [m/s^2]; by default that of a vehicle with linear drag
      alone in calm air, `quadrotor_derivatives`.
    - ``accelerometer`` (3): specific force [m/s^2] in B.
    - ``gyroscope`` (3): w_WB_B [rad/s].

    Samples at the rate from time 0 and holds; before, it measures a vehicle at rest. Sample k, with
    w_k and u_k drawn from N(0, 1), has the noise and the bias (Kalibr's IMU noise model)

        y_k = x_k + b_k + noise sqrt(rate) w_k
        b_k+1 = b_k + walk / sqrt(rate) u_k,  b_0 = 0.

    The draws follow from the seed, the system's name and k.
    """

    def __init__(self, config: Imu, params: QuadrotorParams, seed: int) -> None:
        super().__init__()
        config.validate()
        self._config, self._params, self._seed = config, params, seed
        self._noise = np.repeat([config.accelerometer_noise, config.gyroscope_noise], 3)
        self._walk = np.repeat([config.accelerometer_walk, config.gyroscope_walk], 3)
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("command", 4)
        self.DeclareVectorInputPort("acceleration", 3)
        at_rest = self.DeclareDiscreteState(np.array([0.0, 0.0, params.gravity]))
        self.DeclareStateOutputPort("accelerometer", at_rest)
        self.DeclareStateOutputPort("gyroscope", self.DeclareDiscreteState(3))
        self.DeclareDiscreteState(6)  # biases
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._sample)

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = vector_input(self, "state", context)
        a_WB = optional_input(self, "acceleration", context)
        if a_WB is None:
            command = vector_input(self, "command", context)
            a_WB = np.array(quadrotor_derivatives(state, command, self._params)[3:6])
        rate, bias = self._config.rate, np.array(context.get_discrete_state(2).value())
        white, step = white_noise(self, self._seed, context.get_time(), rate, 12).reshape(2, 6)
        force = specific_force(state, a_WB, self._params.gravity)
        measured = np.append(force, QuadrotorState.of(state).w_WB_B)
        error, next_bias = measurement_error(bias, white, step, self._noise, self._walk, rate)
        measured += error
        for group, values in enumerate((measured[:3], measured[3:], next_bias)):
            discrete_state.set_value(group, values)


def white_noise(system: Any, seed: int, time: float, rate: float, count: int) -> np.ndarray:
    """Returns the draws (count,) from N(0, 1) of a sensor's sample at a time [s], of the rate [Hz].

    They follow from the seed, the system's name and the sample's number.
    """
    block, row = divmod(int(np.floor(time * rate + 1e-6)), _BLOCK)
    return _noise_block(seed, zlib.crc32(system.get_name().encode()), block, count)[row]


@lru_cache(maxsize=64)
def _noise_block(seed: int, name: int, block: int, count: int) -> np.ndarray:
    noise = np.random.default_rng([seed, name, block]).standard_normal((_BLOCK, count))
    noise.flags.writeable = False
    return noise


@dataclass
class RangeFinder(Config):
    """A range finder at the origin of the body, which looks down by default; see
    `RangeFinderSensor`.

    Its output is ``range`` (1) [m].
    """

    # Direction in body axes: x forward, y left, z up.
    direction: list[float] = bounded(lambda: [0.0, 0.0, -1.0], "(-inf, inf)")
    # [m] Maximum distance.
    max_range: float = bounded(10.0, "(0, inf) m")
    # [m] Standard deviation of the noise.
    noise: float = bounded(0.02, "[0, inf) m")
    # [Hz] Draws of the noise per second.
    rate: float = bounded(50.0, "(0, 1000] Hz")

    def check(self) -> None:
        valid = len(self.direction) == 3 and any(self.direction)
        require_field(self, "direction", valid, "three numbers x, y, z, not all 0")


_TOLERANCE = 1e-4  # [m]


def cast_ray(
    field: Distances, p_WQ: np.ndarray, direction_W: np.ndarray, max_range: float
) -> float:
    """Computes by sphere tracing (Hart 1996) the distance [m] from p_WQ (3,) to the first surface.

    The direction (3,) is a unit vector. Without a surface within `max_range` [m] and beyond the
    bounds of the field, the distance is infinite.
    """
    traveled = 0.0
    while traveled <= max_range:
        distance = float(field.distance(p_WQ + traveled * direction_W))
        if np.isnan(distance):
            return np.inf
        traveled += distance
        if distance < _TOLERANCE:
            return max(0.0, traveled)
    return np.inf


class RangeFinderSensor(LeafSystem):
    """Measures the distance along a ray that is fixed to the vehicle.

    .. pydrake_system::

        name: RangeFinderSensor
        input_ports: [body_pose, moving (optional)]
        output_ports: [range]

    - ``body_pose``: X_WB.
    - ``moving``: bodies that the ray may hit, see `MovingBodies`.
    - ``range`` (1): [m] to the distance field's surface plus noise; infinite beyond the maximum.

    The noise follows from the seed, the system's name and the sample's number.
    """

    def __init__(self, config: RangeFinder, field: DistanceField, seed: int) -> None:
        super().__init__()
        config.validate()
        self._config, self._field, self._seed = config, field, seed
        direction = np.array(config.direction)
        self._direction_B = direction / np.linalg.norm(direction)
        self.DeclareAbstractInputPort("body_pose", Value(RigidTransform()))
        self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
        tickets = {self.all_input_ports_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("range", 1, self._calc, prerequisites_of_calc=tickets)

    def _calc(self, context: Context, output: BasicVector) -> None:
        X_WB = cast(RigidTransform, self.GetInputPort("body_pose").Eval(context))
        bodies = optional_input(self, "moving", context)
        field = bodies.among(self._field, bodies.time) if bodies else self._field
        direction_W, config = X_WB.rotation().multiply(self._direction_B), self._config
        distance = cast_ray(field, X_WB.translation(), direction_W, config.max_range)
        [error] = white_noise(self, self._seed, context.get_time(), config.rate, 1)
        measured = distance + config.noise * error
        output.SetAtIndex(0, measured if measured <= config.max_range else np.inf)
