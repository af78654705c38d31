"""Quadrotor dynamics with commanded thrust and body rates, as pure functions.

State (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
Command (4): ``[c [m/s^2], w_cmd_B (3) [rad/s]]``, with c the thrust over mass along body +z.

`quadrotor_derivatives` is the model of policies and training: exact thrust, one lag, linear drag.
Its formula serves floats, torch and numpy batches, and Drake's AutoDiffXd and Expression, so that
the simulated plant and the training loop share one model. `actuated_derivatives` adds actuators,
aerodynamics and battery.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.value import AbstractValue
from pydrake.math import max as maximum
from pydrake.math import min as minimum
from pydrake.math import sqrt
from pydrake.symbolic import Expression
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
    ValueProducer,
)

from splatpilot import _native
from splatpilot.systems.common.drake import (
    ConfigParameter,
    float_values,
    parameter_setter,
    require_finite,
    system_template,
    weak_callback,
)
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    require,
    require_field,
    require_type,
)
from splatpilot.systems.vehicle.state import QuadrotorState, array_namespace, require_rotation

VEHICLE_RADIUS = 0.354
"""Propeller-tip radius of the vehicle [m]: closer than this to a surface is a collision."""

GRAVITY = 9.81  # Standard gravity [m/s^2], along -z of the world.

_TINY = 1e-12  # Keeps roots, their gradients and quotients finite.
_NORM_GAIN = 5.0  # [1/s] pull of the quaternion toward unit length; errors decay as exp(-10 t).


@dataclass
class QuadrotorParams(Config):
    """Parameters of the quadrotor.

    The defaults are the model of the benchmark: a small camera drone whose thrust is exact, and
    whose body rates have one lag. Any other field that is set adds its effect. With
    ``model: rotors`` an onboard controller tracks the body rates by the torques of four rotors.
    """

    # Model of thrust and rates: first-order `lags` behind their commands, or `rotors`: a rate
    # controller, a mixer that saturates, and rotor speeds with a lag.
    model: str = bounded("lags", "{lags, rotors}")
    # [1/s] Linear drag coefficient over mass. Identified racing quadrotors have 0.39-0.54
    # (Faessler, Franchi, Scaramuzza, RA-L 2018).
    drag: float = bounded(0.375, "[0, inf) 1/s")
    # [1/s] Further linear drag over mass along body x, y, z, the rotor drag of Faessler et al.
    rotor_drag: list[float] = bounded(lambda: [0.0] * 3, "[0, inf) 1/s")
    # [1/m] Quadratic drag over mass along body x, y, z, times the speed in the air.
    quadratic_drag: list[float] = bounded(lambda: [0.0] * 3, "[0, inf) 1/m")
    # [s] First-order lag of the body rates behind their command; with rotors, the inverse gain of
    # the rate controller.
    rate_time_constant: float = bounded(0.05, "(0, inf) s")
    # [-] Time constant of yaw over that of roll and pitch.
    yaw_time_ratio: float = bounded(1.0, "(0, inf)")
    # [s] First-order lag of the thrust; with rotors, of their speeds; 0 disables it.
    motor_time_constant: float = bounded(0.0, "[0, inf) s")
    # [m/s^2] Minimum thrust over mass.
    min_thrust: float = bounded(0.0, "[0, inf) m/s^2")
    # [m/s^2] Maximum thrust over mass; that of a rotor is a quarter.
    max_thrust: float = bounded(math.inf, "(0, inf] m/s^2")
    # [rad/s] Maximum roll and pitch rate.
    max_tilt_rate: float = bounded(math.inf, "(0, inf] rad/s")
    # [rad/s] Maximum yaw rate.
    max_yaw_rate: float = bounded(math.inf, "(0, inf] rad/s")
    # [-] Thrust over its command, the error of the hover thrust.
    thrust_scale: float = bounded(1.0, "(0, 2]")
    # [-] Fraction of the thrust that an empty battery loses, by the square of its voltage.
    battery_sag: float = bounded(0.0, "[0, 1)")
    # [-] Charge of the battery at the start.
    battery_charge: float = bounded(1.0, "[0, 1]")
    # [s] Time of hovering that empties a full battery.
    battery_endurance: float = bounded(math.inf, "(0, inf] s")
    # [m] Radius of the rotors for the ground effect over the plane z = 0; 0 disables it.
    ground_effect: float = bounded(0.0, "[0, inf) m")
    # [m/s^2] Gravitational acceleration, along -z of the world.
    gravity: float = bounded(GRAVITY, "[0, inf) m/s^2")
    # [m] Radius of the collision sphere, to the tips of the propellers. Policies and generated
    # worlds assume the default.
    radius: float = bounded(VEHICLE_RADIUS, "(0, 1] m")
    # [kg] Mass, of rotors only, as the following fields. They are PX4's simulated quadrotor's.
    mass: float = bounded(1.0, "(0, inf) kg")
    # [kg m^2] Moments of inertia about body x, y, z.
    inertia: list[float] = bounded(lambda: [0.025, 0.025, 0.03], "(0, inf) kg m^2")
    # [m] Distances of the rotors from the center of mass along body x and y.
    arm: list[float] = bounded(lambda: [0.2, 0.2], "(0, inf) m")
    # [N s^2/rad^2] Thrust of a rotor over the square of its speed.
    thrust_coefficient: float = bounded(5e-6, "(0, inf) N s^2/rad^2")
    # [m] Torque of a rotor about its axis over its thrust.
    torque_ratio: float = bounded(0.02, "(0, inf) m")

    def check(self) -> None:
        """Raises FieldError for a vehicle that cannot hover, or whose rate loop is unstable."""
        for name, size in _SIZES.items():
            valid = len(getattr(self, name)) == size
            require_field(self, name, valid, f"{size} numbers")
        needed = self.gravity / self.thrust_scale
        needed /= 1.0 - self.battery_sag * (1.0 - self.battery_charge)
        condition = f"above {needed:.4g} m/s^2, to hover"
        require_field(self, "max_thrust", self.max_thrust > needed, condition)
        below = self.min_thrust < needed
        require_field(self, "min_thrust", below, f"below {needed:.4g} m/s^2, to hover")
        if self.model == "rotors":
            finite = math.isfinite(self.max_thrust)
            require_field(self, "max_thrust", finite, "finite [m/s^2] with rotors")
            lag = self.motor_time_constant
            require_field(self, "motor_time_constant", lag > 0.0, "above 0 s with rotors")
            # Rate loop: 1 + s tau + s^2 tau lag, damped by sqrt(tau / lag) / 2.
            fastest = self.rate_time_constant * min(1.0, self.yaw_time_ratio)
            condition = f"at least {0.5 * lag / min(1.0, self.yaw_time_ratio):.4g} s, half of "
            condition += "motor_time_constant, below which the rate controller oscillates"
            require_field(self, "rate_time_constant", fastest >= 0.5 * lag, condition)

    def is_ideal(self) -> bool:
        """Checks if `quadrotor_derivatives` describes the vehicle."""
        neutral = QuadrotorParams()
        return all(getattr(self, name) == getattr(neutral, name) for name in _EFFECTS)

    def min_time_constant(self) -> float:
        """Returns the shortest lag [s]: integration needs steps of at most twice that."""
        lags = [self.rate_time_constant * min(1.0, self.yaw_time_ratio), self.motor_time_constant]
        return min(lag for lag in lags if lag > 0.0)


_SIZES = {"rotor_drag": 3, "quadratic_drag": 3, "inertia": 3, "arm": 2}
_IDEAL = ["drag", "rate_time_constant", "gravity"]
_ROTORS = ["mass", "inertia", "arm", "thrust_coefficient", "torque_ratio"]
_NAMES = [field.name for field in fields(QuadrotorParams)]
_EFFECTS = [name for name in _NAMES if name not in (*_IDEAL, *_ROTORS, "radius")]
_FURTHER = [name for name in (*_EFFECTS, *_ROTORS) if name not in ("model", "battery_charge")]


def hover_state(p_WB: Sequence[float] | np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """Returns the state (13,) at rest, level at `p_WB` (3,) [m], facing `yaw` [rad] from x."""
    q_WB = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    return QuadrotorState(p_WB, np.zeros(3), q_WB, np.zeros(3)).to_vector()


def quadrotor_derivatives(state: Any, command: Any, params: QuadrotorParams) -> Any:
    """Returns the time derivative (..., 13) of ``state`` (..., 13) under ``command`` (..., 4).

    Their leading shapes broadcast. With z_B the body z axis and ⊗ the Hamilton product::

        d/dt p_WB   = v_WB
        d/dt v_WB   = c z_B - g e_z - drag v_WB
        d/dt q_WB   = 1/2 q_WB ⊗ (0, w_WB_B) + 5 (1 - |q_WB|²) q_WB
        d/dt w_WB_B = (w_cmd_B - w_WB_B) / rate_time_constant

    The last term of the quaternion rate holds its length at one against integration error.
    """
    rates = component_derivatives(
        [state[..., i] for i in range(13)],
        [command[..., i] for i in range(4)],
        *(params.drag, params.rate_time_constant, params.gravity),
    )
    xp = array_namespace(state)
    if xp is not np:
        return xp.stack(xp.broadcast_tensors(*rates), dim=-1)
    shape = np.broadcast_shapes(state.shape[:-1], command.shape[:-1])
    derivatives = np.empty((*shape, 13), np.result_type(state, command))
    for i, rate in enumerate(rates):
        derivatives[..., i] = rate
    return derivatives


def component_derivatives(
    state: Any,
    command: Any,
    drag: Any,
    rate_time_constant: Any,
    gravity: Any,
    wind: Any = None,
    disturbance: Any = None,
) -> tuple[Any, ...]:
    """Returns the 13 components of :func:`quadrotor_derivatives` from 13 + 4 components; plain
    Python floats are by far the fastest for a single vehicle.

    Args:
        wind: v_WA (3) [m/s] of the air in W: drag acts on v_WB - v_WA.
        disturbance: added acceleration (3) [m/s^2] in W.
    """
    _, _, _, vx, vy, vz, qw, qx, qy, qz, wx, wy, wz = state
    c, wx_cmd, wy_cmd, wz_cmd = command
    norm2 = qw * qw + qx * qx + qy * qy + qz * qz
    thrust = c / norm2
    pull = _NORM_GAIN * (1.0 - norm2)
    v_AB = (vx, vy, vz) if wind is None else (vx - wind[0], vy - wind[1], vz - wind[2])
    a_WB = (
        thrust * (2.0 * (qx * qz + qw * qy)) - drag * v_AB[0],
        thrust * (2.0 * (qy * qz - qw * qx)) - drag * v_AB[1],
        thrust * (qw * qw - qx * qx - qy * qy + qz * qz) - drag * v_AB[2] - gravity,
    )
    if disturbance is not None:
        a_WB = tuple(a + added for a, added in zip(a_WB, disturbance, strict=True))
    return (
        *(vx, vy, vz),
        *a_WB,
        0.5 * (-qx * wx - qy * wy - qz * wz) + pull * qw,
        0.5 * (qw * wx + qy * wz - qz * wy) + pull * qx,
        0.5 * (qw * wy + qz * wx - qx * wz) + pull * qy,
        0.5 * (qw * wz + qx * wy - qy * wx) + pull * qz,
        (wx_cmd - wx) / rate_time_constant,
        (wy_cmd - wy) / rate_time_constant,
        (wz_cmd - wz) / rate_time_constant,
    )


def actuated_derivatives(
    state: Any, command: Any, params: QuadrotorParams, wind: Any = None, disturbance: Any = None
) -> list[Any]:
    """Returns the time derivatives of the components of an actuated vehicle.

    To `component_derivatives` it adds, with v the velocity in the air and s the charge::

        a_drag_B = -(rotor_drag + quadratic_drag |v|) v_B
        lift     = thrust_scale (1 - battery_sag (1 - s)) / (1 - (ground_effect / 4 z)²)
        d/dt s   = -(c_now / g)^1.5 / battery_endurance
        lags:    c_now = lift c_lag,  d/dt c_lag = (c - c_lag) / motor_time_constant
        rotors:  f_i = lift k u_i²,   d/dt u_i = (sqrt(f_cmd_i / k) - u_i) / motor_time_constant
                 J d/dt w = M(f) - w × J w,  M(f_cmd) = J (w_cmd - w) / tau + w × J w

    `mix` limits f_cmd. Sources: rotor drag, Faessler et al., RA-L 2018;
    ground effect, Cheeseman and Bennett, ARC R&M 3021, 1955, at most that of z = ground_effect / 2;
    power by momentum theory; rate controller, Foehn et al., "Agilicious", Science Robotics 2022.

    Args:
        state: 13 components of the state, the charge, and, unless `motor_time_constant` is 0, the
            thrust over mass [m/s^2] or, with rotors, their speeds (4) [rad/s], see `mix`.
        command: of `limit_command`.
        wind, disturbance: see `component_derivatives`.
    """
    _, _, z, *velocity = state[:6]
    (qw, *q), rates, charge, actuators = state[6:10], state[10:13], state[13], state[14:]
    added = disturbance
    if not _are_zero(*params.rotor_drag, *params.quadratic_drag):  # They cost as much as the rest.
        scale = 2.0 / (qw * qw + _dot(q, q))
        v_AB = velocity if wind is None else [v - w for v, w in zip(velocity, wind, strict=True)]
        speed = sqrt(_dot(v_AB, v_AB) + _TINY)
        drags = zip(params.rotor_drag, params.quadratic_drag, strict=True)
        coefficients = [linear + quadratic * speed for linear, quadratic in drags]
        v_AB_B = _rotate(scale, -qw, q, v_AB)
        a_B = [-c * v for c, v in zip(coefficients, v_AB_B, strict=True)]
        added = _rotate(scale, qw, q, a_B)
        if disturbance is not None:
            added = [a + more for a, more in zip(added, disturbance, strict=True)]

    lift = lift_factor(z, charge, params)
    thrust_cmd, *rates_cmd = command
    lag = params.rate_time_constant
    accelerations = [
        (rates_cmd[0] - rates[0]) / lag,
        (rates_cmd[1] - rates[1]) / lag,
        (rates_cmd[2] - rates[2]) / (lag * params.yaw_time_ratio),
    ]
    if params.model == "rotors":
        forces = [lift * params.thrust_coefficient * u * u for u in actuators]
        thrust = sum(forces) / params.mass
        momentum = [J * w for J, w in zip(params.inertia, rates, strict=True)]
        gyroscopic = _cross(rates, momentum)
        torques_cmd = [
            J * a + g for J, a, g in zip(params.inertia, accelerations, gyroscopic, strict=True)
        ]
        desired = mix(params.mass * thrust_cmd, torques_cmd, params)
        targets = [sqrt(maximum(f, _TINY) / params.thrust_coefficient) for f in desired]
        accelerations = [
            (M - g) / J
            for M, g, J in zip(torques(forces, params), gyroscopic, params.inertia, strict=True)
        ]
    else:
        thrust, targets = lift * (actuators[0] if actuators else thrust_cmd), [thrust_cmd]
    return [
        *component_derivatives(
            state[:13], (thrust, *rates), params.drag, 1.0, params.gravity, wind, added
        )[:10],
        *accelerations,
        charge_rate(thrust, params),
        *(
            (u - now) / params.motor_time_constant
            for u, now in zip(targets, actuators, strict=False)
        ),
    ]


def charge_rate(thrust: Any, params: QuadrotorParams) -> Any:
    """Returns the rate [1/s] of the charge at a thrust over mass [m/s^2]; `battery_endurance` is
    that at standard gravity."""
    power = maximum(thrust / GRAVITY, _TINY)
    return -power * sqrt(power) * (1.0 / params.battery_endurance)  # x / inf of AutoDiffXd is NaN


def knows_natively(params: QuadrotorParams) -> bool:
    """Tells if `_native.actuated_derivatives` is that of a vehicle."""
    lags = params.motor_time_constant > 0.0 and params.rate_time_constant > 0.0
    constant = params.battery_sag == 0.0 and params.ground_effect == 0.0
    return params.model != "rotors" and lags and constant


def native_vehicle(params: QuadrotorParams, wind: Sequence[float] = (0.0, 0.0, 0.0)) -> dict:
    """Returns the numbers of a vehicle among `_native.FLIGHT_PARAMETERS`, by name."""
    motor, lag = params.motor_time_constant, params.rate_time_constant
    names = ("drag", "gravity", "thrust_scale", "min_thrust", "max_thrust", "max_tilt_rate")
    values = {name: getattr(params, name) for name in (*names, "max_yaw_rate")} | {
        "rate_gain": 1.0 / lag,
        "yaw_rate_gain": 1.0 / (lag * params.yaw_time_ratio),
        "motor_gain": 1.0 / motor if motor else 0.0,
    }
    axes = {"rotor_drag": params.rotor_drag, "quadratic": params.quadratic_drag, "wind": wind}
    for name, axis in axes.items():
        values |= {f"{name}_{k}": value for k, value in zip("xyz", axis, strict=True)}
    return values


def lift_factor(z: Any, charge: Any, params: QuadrotorParams) -> Any:
    """Returns the thrust over that of the nominal vehicle, at a height z [m] and a charge."""
    lift = params.thrust_scale * (1.0 - params.battery_sag * (1.0 - maximum(charge, 0.0)))
    if not _are_zero(params.ground_effect):
        height = maximum(z, maximum(0.5 * params.ground_effect, _TINY))
        lift = lift / (1.0 - (0.25 * params.ground_effect / height) ** 2)
    return lift


def limit_command(command: Any, params: QuadrotorParams) -> list[Any]:
    """Returns the components (4) of a command within the limits of the vehicle."""
    limits = params.max_tilt_rate, params.max_tilt_rate, params.max_yaw_rate
    rates = [maximum(-high, minimum(w, high)) for w, high in zip(command[1:], limits, strict=True)]
    return [maximum(params.min_thrust, minimum(command[0], params.max_thrust)), *rates]


def mix(thrust: Any, torque: Any, params: QuadrotorParams) -> list[Any]:
    """Returns the forces (4) [N] of the rotors for a thrust [N] and a torque (3) [N m] about B.

    Rotors are front left, rear left, rear right, front right; the first and third push B to the
    left about z. Beyond their limits, first yaw is given up, then thrust, then roll and pitch.
    """
    low, high = 0.25 * params.mass * params.min_thrust, 0.25 * params.mass * params.max_thrust
    roll, pitch = 0.25 * torque[0] / params.arm[1], 0.25 * torque[1] / params.arm[0]
    tilt = abs(roll) + abs(pitch)
    common = maximum(low + tilt, minimum(0.25 * thrust, high - tilt))
    room = maximum(minimum(high - tilt - common, common - tilt - low), 0.0)
    yaw = maximum(-room, minimum(0.25 * torque[2] / params.torque_ratio, room))
    a, b, c = common + roll, common - roll, pitch - yaw
    d = pitch + yaw
    return [maximum(low, minimum(f, high)) for f in (a - c, a + c, b + d, b - d)]


def torques(forces: Any, params: QuadrotorParams) -> tuple[Any, Any, Any]:
    """Returns the torque (3) [N m] about B of the forces (4) [N] of the rotors."""
    front_left, rear_left, rear_right, front_right = forces
    left, right = front_left + rear_left, rear_right + front_right
    return (
        params.arm[1] * (left - right),
        params.arm[0] * (rear_left + rear_right - front_left - front_right),
        params.torque_ratio * (front_left + rear_right - rear_left - front_right),
    )


def _are_zero(*numbers: Any) -> bool:
    """Checks if numbers are floats and zero: AutoDiffXd keeps its derivatives."""
    return type(numbers[0]) is float and not any(numbers)


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _rotate(scale: Any, w: Any, q: Any, vector: Any) -> list[Any]:
    """Rotates a vector (3) by the quaternion (w, q), where `scale` is 2 / (w² + q²)."""
    once = _cross(q, vector)
    twice = _cross(q, once)
    return [v + scale * (w * a + b) for v, a, b in zip(vector, once, twice, strict=True)]


def _cross(a: Any, b: Any) -> tuple[Any, Any, Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def rk4_step(state: Any, command: Any, params: QuadrotorParams, dt: Any) -> Any:
    """Returns the state (..., 13) after ``dt`` [s] of constant ``command`` (..., 4), by one step of
    the classical Runge-Kutta method, for the array types of :func:`quadrotor_derivatives`."""
    k1 = quadrotor_derivatives(state, command, params)
    k2 = quadrotor_derivatives(state + 0.5 * dt * k1, command, params)
    k3 = quadrotor_derivatives(state + 0.5 * dt * k2, command, params)
    k4 = quadrotor_derivatives(state + dt * k3, command, params)
    return state + (dt / 6.0) * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@system_template("QuadrotorPlant_", (float, AutoDiffXd, Expression))
def QuadrotorPlant_(T):
    class QuadrotorPlant(LeafSystem_[T]):
        """Simulates a quadrotor by thrust and body rates.

        .. pydrake_system::

            name: QuadrotorPlant
            input_ports: [command, wind, disturbance]
            output_ports: [state, acceleration]

        - ``command`` (4), ``state`` (13): as at the top of this module; by default a level hover at
          the world's origin.
        - ``wind`` (3), optional: v_WA [m/s] of the air in W; drag acts on v_WB - v_WA.
        - ``disturbance`` (3), optional: acceleration [m/s^2] in W, added to that of the forces.
        - ``acceleration`` (3): a_WB [m/s^2].
        - Continuous state: the 13, and if `QuadrotorParams.is_ideal` is false those of
          `actuated_derivatives`, at the charge and thrust of the start.
        - Numeric parameter 0: ``[drag [1/s], rate_time_constant [s], gravity [m/s^2]]``, then, if
          `is_ideal` is false, the other numbers of the configuration.

        See `quadrotor_derivatives` and `actuated_derivatives`. Supports the scalars float,
        AutoDiffXd and Expression. A subclass supports them if it is a `system_template` of its own.
        Integrate in steps of at most 0.02 s: after 5 s of random commands at 50 Hz,
        ``runge_kutta3`` is within 2 cm of the solution.
        """

        def __init__(
            self,
            params: QuadrotorParams | None = None,
            initial_state: np.ndarray | None = None,
            *,
            converter: Any = None,
        ):
            super().__init__(converter=converter)
            params = QuadrotorParams() if params is None else params
            require_type(params, QuadrotorParams, "params")
            params.validate()
            start = hover_state([0.0, 0.0, 0.0]) if initial_state is None else initial_state
            start = np.array(start, dtype=float)
            valid = start.shape == (13,) and np.isfinite(start).all()
            require(valid, "initial_state", "13 finite numbers", start.tolist())
            require_rotation(QuadrotorState.of(start).q_WB)
            self._ideal = params.is_ideal()
            self._derivatives = component_derivatives if self._ideal else actuated_derivatives
            names = _IDEAL if self._ideal else _IDEAL + _FURTHER
            self._parameters = [ConfigParameter(self, T, params, names)]
            for name, size in (("command", 4), ("wind", 3), ("disturbance", 3)):
                self.DeclareVectorInputPort(name, size)
            actuators = [] if self._ideal else hovering_actuators(params)
            self._size = 13 + len(actuators)
            index = self.DeclareContinuousState(BasicVector_[T]([*start, *actuators]))
            if self._ideal:
                self.DeclareStateOutputPort("state", index)
            else:
                self.DeclareVectorOutputPort("state", 13, self._calc_state, {self.xc_ticket()})
            self.DeclareVectorOutputPort("acceleration", 3, self._calc_acceleration)
            # Most inputs are constant within a step.
            calc = weak_callback(self._calc_inputs)
            self._inputs_index = self.DeclareCacheEntry(
                "inputs and parameters",
                ValueProducer(lambda: AbstractValue.Make(object()), calc),
                {self.all_input_ports_ticket(), self.all_parameters_ticket()},
            ).cache_index()

        SetDrag = parameter_setter("drag")
        SetRateTimeConstant = parameter_setter("rate_time_constant")
        SetGravity = parameter_setter("gravity")

        def SetParameter(self, context, name, value):
            """Sets a number of the configuration, or a list of numbers, in a Context."""
            known = self._parameters[0].names
            require(name in known, "name", f"one of {', '.join(known)}", name)
            if name == "motor_time_constant":  # The thrust is a state only if it is not 0.
                has_lag = bool(self._parameters[0].config(context).motor_time_constant)
                remedy = "construct another plant"
                require(has_lag == bool(value), name, "0 only if it was", value, remedy)
            parameter_setter(name)(self, context, value)

        def get_input_port(self, port_index=0):
            """Returns an input port by its index; `command` by default."""
            return super().get_input_port(port_index)

        def get_output_port(self, port_index=0):
            """Returns an output port by its index; `state` by default."""
            return super().get_output_port(port_index)

        def DoCalcTimeDerivatives(self, context, derivatives):
            vector, rates = derivatives.get_mutable_vector(), self._rates(context)
            if isinstance(rates, np.ndarray):
                return vector.SetFromVector(rates)
            for i, rate in enumerate(rates):
                vector.SetAtIndex(i, rate)

        def _rates(self, context):
            vector = context.get_continuous_state_vector()
            inputs, native = self.get_cache_entry(self._inputs_index).Eval(context)
            if native:
                rates, state = np.empty(self._size), vector.CopyToVector()
                if self._ideal:
                    _native.quadrotor_derivatives(state, *native, derivatives=rates)
                else:
                    _native.actuated_derivatives(state, *native, derivatives=rates)
                    params = inputs[1]
                    rates[13] = charge_rate(params.thrust_scale * state[14], params)
                if not math.isnan(rates[3]):  # as of a quaternion of zeros
                    return rates
            # Python floats, one by one: several times faster than arrays of numpy.
            state = [vector.GetAtIndex(i) for i in range(self._size)]
            try:
                return self._derivatives(state, *inputs)
            except ZeroDivisionError:
                lag = inputs[2] if self._ideal else inputs[1].rate_time_constant
                raise ValueError(
                    f"q_WB and rate_time_constant of {self.get_name()} must not be zero, got "
                    f"{state[6:10]} and {lag} s at t = {context.get_time()} s"
                ) from None

        def _calc_state(self, context, output):
            vector = context.get_continuous_state_vector()
            for i in range(13):
                output.SetAtIndex(i, vector.GetAtIndex(i))

        def _calc_acceleration(self, context, output):
            output.SetFromVector(self._rates(context)[3:6])

        def _calc_inputs(self, context, inputs):
            """Computes the arguments of the derivatives after the state."""
            command, wind, disturbance = (self._read(index, context) for index in range(3))
            params = self._parameters[0].config(context)
            parameters = [getattr(params, name) for name in _IDEAL] if self._ideal else [params]
            if not self._ideal:
                command = limit_command(command, params)
            native = ()
            plain = T is float and disturbance is None
            if plain and not self._ideal and knows_natively(params):
                numbers = dict.fromkeys(_native.FLIGHT_PARAMETERS, 0.0)
                numbers |= native_vehicle(params, (0.0,) * 3 if wind is None else wind)
                native = np.array(command), np.array([*numbers.values()])
            elif plain and self._ideal and parameters[1] and wind is None:
                native = np.array(command), *parameters
            inputs.set_value(((command, *parameters, wind, disturbance), native))

        def _read(self, index, context):
            vector = self.EvalVectorInput(context, index)
            if vector is None:  # Drake raises for a command that is not connected.
                return None if index > 0 else self.get_input_port(index).Eval(context)
            value = vector.value()
            if T is not Expression:  # Error control would shorten the steps without end.
                require_finite(self.get_input_port(index), context, float_values(value))
            return value.tolist()

    return QuadrotorPlant


def hovering_actuators(params: QuadrotorParams) -> list[float]:
    """Returns the charge at the start, and the thrust or the rotor speeds of hovering."""
    if params.model == "rotors":
        force = 0.25 * params.mass * params.gravity / params.thrust_coefficient
        return [params.battery_charge, *[math.sqrt(force)] * 4]
    return [params.battery_charge, *([params.gravity] if params.motor_time_constant else [])]


QuadrotorPlant = QuadrotorPlant_[None]
