"""Differential flatness of the quadrotor: from an acceleration to thrust and body rates.

The specific thrust supplies the desired acceleration, carries the weight and overcomes drag; its
direction is the body z axis, and yaw fixes the rest (Mellinger and Kumar, "Minimum snap trajectory
generation and control for quadrotors", ICRA 2011; with drag: Faessler, Franchi and Scaramuzza,
RA-L 2018). Rates tilt the body z axis by the shortest rotation and yaw slower, since only tilt
moves the vehicle (Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude control",
T-CST 2018).

Frames: W world, B body, D the desired body. The functions take numpy arrays (of AutoDiffXd too) or
torch tensors of one vehicle or of N, and are differentiable. Thrust is over mass [m/s^2], angles
are in rad.
"""

import math
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)

from splatpilot import _native
from splatpilot.systems.common.drake import (
    ConfigParameter,
    float_values,
    optional_input,
    parameter_setter,
    require_finite,
    system_template,
    vector_input,
)
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    require_field,
    require_type,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.state import (
    QuadrotorState,
    array_namespace,
    clip,
    require_rotation,
    rotation_matrices,
    stack,
    unit_vectors,
)

_TINY = 1e-12  # Keeps directions and gradients finite where a length is zero.


def reaching_acceleration(p_WR: Any, p_WB: Any, v_WB: Any, lookahead: float) -> Any:
    """Returns the constant acceleration (..., 3) [m/s^2] that reaches p_WR [m] in `lookahead` [s].

    Applied continually with p_WR(t) = r(t + T), it makes p_WB follow r with the transfer function
    e^x / (1 + x + x²/2), x = sT: an error of third order in T, damped at 1/√2. A lag of T/3 between
    commanded and actual acceleration removes the third order too.
    """
    return 2.0 * (p_WR - p_WB - lookahead * v_WB) / lookahead**2


def attitude_from_thrust(f_W: Any, yaw: Any) -> Any:
    """Returns R_WD (..., 3, 3): z along the upward `f_W` (..., 3), and x, seen from above, exactly
    along `yaw` (...)."""
    xp = array_namespace(f_W)
    zx, zy, zz = _components(unit_vectors(f_W))
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x = stack([cos * zz, sin * zz, -sin * zy - cos * zx])  # left x z
    xx, xy, xz = _components(unit_vectors(x))
    y = [zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx]  # z x x
    return stack([[xx, y[0], zx], [xy, y[1], zy], [xz, y[2], zz]])


def heading_along_motion(motion_W: Any, full_speed: float) -> tuple[Any, Any]:
    """Returns the heading (...) [rad] of a motion (..., 3) [m/s] and how strongly to follow it: 1,
    or less below a horizontal speed of `full_speed` [m/s], so that noise has no effect."""
    x, y = motion_W[..., 0], motion_W[..., 1]
    heading = array_namespace(motion_W).arctan2(y, x)
    return heading, clip((x * x + y * y) / full_speed**2, high=1.0)


@dataclass
class FlatnessControllerConfig(Config):
    """Gains and limits of the controller."""

    # [s] Time between updates.
    period: float = bounded(0.02, "[1e-4, inf) s")
    # [s] How far ahead of now the waypoint lies. At three times the attitude's lag, 3 / tilt_gain,
    # that lag cancels the leading tracking error; longer is smoother, shorter stiffer.
    lookahead: float = bounded(0.4, "(0, inf) s")
    # [m/s^2] Minimum thrust over mass.
    min_thrust: float = bounded(2.0, "(0, inf) m/s^2")
    # [m/s^2] Maximum thrust over mass.
    max_thrust: float = bounded(20.0, "(0, inf) m/s^2")
    # [rad] Maximum commanded angle between body z and vertical, below pi/2.
    max_tilt: float = bounded(0.8, "(0, 1.5707) rad")
    # [1/s] Commanded roll and pitch rate per angle of tilt error.
    tilt_gain: float = bounded(10.0, "(0, inf) 1/s")
    # [rad/s] Maximum commanded rate about an axis in the body's x-y plane.
    max_tilt_rate: float = bounded(6.0, "(0, inf) rad/s")
    # [1/s] Commanded yaw rate per angle of yaw error.
    yaw_gain: float = bounded(3.0, "(0, inf) 1/s")
    # [rad/s] Maximum commanded yaw rate.
    max_yaw_rate: float = bounded(2.0, "(0, inf) rad/s")
    # [m/s] Horizontal speed from which yaw follows the motion fully.
    yaw_speed: float = bounded(0.5, "(0, inf) m/s")
    # [s] Time constant of the estimate of acceleration that the model does not explain, such as by
    # an error of the hover thrust or wind; 0 is without, see `observe_disturbance`.
    disturbance_time: float = bounded(0.0, "[0, inf) s")
    # [m/s^2] Maximum of that estimate along each axis.
    max_disturbance: float = bounded(3.0, "(0, inf) m/s^2")

    def check(self) -> None:
        below = self.min_thrust < self.max_thrust
        require_field(self, "min_thrust", below, f"below max_thrust, {self.max_thrust} m/s^2")
        # A slower attitude cannot follow, and the vehicle oscillates.
        shortest = 2.0 / self.tilt_gain
        condition = f"at least 2 / tilt_gain = {shortest:.3g} s"
        require_field(self, "lookahead", self.lookahead >= shortest, condition)
        # A faster estimate would take the vehicle's own lag for a disturbance.
        slow = self.disturbance_time == 0.0 or self.disturbance_time >= self.lookahead
        condition = f"0 or at least lookahead, {self.lookahead} s"
        require_field(self, "disturbance_time", slow, condition)


def flatness_command(
    state: Any,
    a_WB: Any,
    motion_W: Any,
    heading: Any,
    config: FlatnessControllerConfig,
    params: QuadrotorParams,
) -> Any:
    """Returns thrust over mass and body rates (..., 4) for an acceleration.

    With z_B the body z axis and limits at every step::

        f_W     = a_WB + g e_z + drag v_WB
        c       = f_W · z_B
        w_cmd_B = [tilt_gain · tilt, yaw_gain · yaw]

    Tilt and yaw rotate the body so that z lies along f_W and x along the heading or the motion.

    Args:
        state: (..., 13).
        a_WB: (..., 3) [m/s^2], gravity excluded.
        motion_W: (..., 3) [m/s], gives the heading where `heading` does not.
        heading: (...) [rad], NaN if free; or None.
    """
    xp = array_namespace(state)
    _, v_WB, q_WB, _ = QuadrotorState.of(state)
    R_WB = rotation_matrices(q_WB)

    fx, fy, fz = _components(a_WB + params.drag * v_WB)
    fz = clip(fz + params.gravity, low=config.min_thrust)
    widest = fz * np.tan(config.max_tilt)  # keeps the lift, gives up sideways thrust
    shrink = clip(widest / xp.sqrt(fx * fx + fy * fy + _TINY), high=1.0)
    f_W = stack([shrink * fx, shrink * fy, fz])
    f_W = f_W * clip(config.max_thrust / xp.sqrt((f_W * f_W).sum(-1, keepdims=True)), high=1.0)

    along, strength = heading_along_motion(motion_W, config.yaw_speed)
    if heading is None:
        heading = along
    else:
        free = heading != heading  # NaN, of any type of number
        heading = xp.where(free, along, heading)
        strength = xp.where(free, strength, xp.ones_like(strength))
    R_BD = R_WB.mT @ attitude_from_thrust(f_W, heading)

    # First rotate by `angle` about n, in the body's x-y plane, which takes its z axis to D's. With
    # opposite z axes _TINY selects body x as n.
    z1, z2, z3 = _components(R_BD[..., 2])
    z2 = z2 - _TINY
    sine = xp.sqrt(z1 * z1 + z2 * z2 + _TINY**3)
    angle = xp.arctan2(sine, z3)
    n1, n2 = -z2 / sine, z1 / sine
    rate = clip(config.tilt_gain * angle, high=config.max_tilt_rate)
    # Then yaw to D's x axis, seen from the tilted body.
    x1, x2, x3 = _components(R_BD[..., 0])
    cosine, sine = xp.cos(angle), xp.sin(angle)
    onto_n = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + onto_n * n1
    left = cosine * x2 + sine * n1 * x3 + onto_n * n2
    yaw = config.yaw_gain * strength * xp.arctan2(left, ahead)
    yaw = clip(yaw, -config.max_yaw_rate, config.max_yaw_rate)
    thrust = clip((f_W * R_WB[..., 2]).sum(-1), config.min_thrust, config.max_thrust)
    return stack([thrust, rate * n1, rate * n2, yaw])


def native_control(config: FlatnessControllerConfig, params: QuadrotorParams) -> dict[str, float]:
    """Returns the numbers of the controller among `_native.FLIGHT_PARAMETERS`, by name."""
    names = ("lookahead", "tilt_gain", "yaw_gain", "yaw_speed")
    return {name: getattr(config, name) for name in names} | {
        "drag": params.drag,
        "gravity": params.gravity,
        "control_min": config.min_thrust,
        "control_max": config.max_thrust,
        "control_tilt": config.max_tilt_rate,
        "control_yaw": config.max_yaw_rate,
        "max_tilt_tangent": math.tan(config.max_tilt),
    }


def observe_disturbance(
    state: Any,
    observed: Any,
    thrust: Any,
    config: FlatnessControllerConfig,
    params: QuadrotorParams,
) -> Any:
    """Returns the next velocity [m/s] and disturbance [m/s^2], (6,), that an observer estimates.

    A Luenberger observer with both poles at -1 / `disturbance_time` predicts the velocity u from
    the thrust c that was commanded since the last update, within its limits, so that it does not
    wind up. With T the period, b = T / disturbance_time and e = v_WB - u::

        u' = u + T (c z_B - g e_z - drag v_WB + d) + 2 b e
        d' = clip(d + b² e / T)

    Args:
        state: (13,) at the end of the period.
        observed: (6,), the last result.
        thrust: c [m/s^2].
    """
    # Numbers one by one: several times faster than arrays of numpy.
    v_WB, (w, x, y, z) = state[3:6].tolist(), state[6:10].tolist()
    numbers, T = observed.tolist(), config.period
    lift = thrust / (w * w + x * x + y * y + z * z)
    z_B = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)
    gain, limit = T / config.disturbance_time, config.max_disturbance
    speeds, disturbances = [], []
    for k, (u, d, v) in enumerate(zip(numbers[:3], numbers[3:], v_WB, strict=True)):
        model = lift * z_B[k] - params.drag * v - (params.gravity if k == 2 else 0.0)
        speeds.append(u + T * (model + d) + 2.0 * gain * (v - u))
        disturbances.append(max(-limit, min(d + gain**2 / T * (v - u), limit)))
    return np.array([*speeds, *disturbances])


def _components(vectors: Any) -> tuple[Any, Any, Any]:
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


@system_template("FlatnessController_")
def FlatnessController_(T):
    class FlatnessController(LeafSystem_[T]):
        """Flies a quadrotor to a waypoint, or with an acceleration, by thrust and body rates.

        .. pydrake_system::

            name: FlatnessController
            input_ports: [state, waypoint, acceleration, heading]
            output_ports: [command]

        - ``state`` (13), ``command`` (4): see `QuadrotorPlant`; the command is held between
          updates, and that of hovering before the first.
        - ``waypoint`` (3): p_WR [m], where the vehicle should be ``lookahead`` seconds from now; or
          ``acceleration`` (3): a_WB [m/s^2], gravity excluded. Connect exactly one.
        - ``heading`` (1), optional: of body x, seen from above, [rad] from world x; along the
          motion if it is not connected or NaN.
        - Discrete state: the command and, if ``disturbance_time`` > 0, the estimates (6) of
          `observe_disturbance`, whose disturbance is subtracted from the acceleration.
        - Numeric parameter 0 (9): the fields of the configuration from ``lookahead`` to
          ``yaw_speed``; numeric parameter 1 (2): ``[drag [1/s], gravity [m/s^2]]`` of the vehicle.

        Updates every ``period`` [s] from time 0, see `reaching_acceleration` and
        `flatness_command`. The motion is toward the waypoint, or along v_WB if an acceleration is
        given. Supports the scalars float and AutoDiffXd; derivatives pass through its updates.
        """

        def __init__(
            self,
            config: FlatnessControllerConfig | None = None,
            params: QuadrotorParams | None = None,
            *,
            converter: Any = None,
        ):
            super().__init__(converter=converter)
            config = FlatnessControllerConfig() if config is None else config
            params = QuadrotorParams() if params is None else params
            require_type(config, FlatnessControllerConfig, "config")
            require_type(params, QuadrotorParams, "params")
            self._defaults = config, params = replace(config), replace(params)
            params.validate()
            config.validate()
            lift = params.gravity / math.cos(config.max_tilt)
            condition = f"above {lift:.2f} m/s^2 to carry the weight at max_tilt"
            require_field(config, "max_thrust", config.max_thrust > lift, condition)
            fixed = ("period", "disturbance_time", "max_disturbance")
            gains = [field.name for field in fields(config) if field.name not in fixed]
            self._parameters = [
                ConfigParameter(self, T, config, gains),
                ConfigParameter(self, T, params, ["drag", "gravity"]),
            ]
            numbers = native_control(config, params)
            self._numbers = np.array([numbers.get(n, 0.0) for n in _native.FLIGHT_PARAMETERS])
            sizes = {"state": 13, "waypoint": 3, "acceleration": 3, "heading": 1}
            for name, size in sizes.items():
                self.DeclareVectorInputPort(name, size)
            hover = BasicVector_[T]([params.gravity, 0.0, 0.0, 0.0])
            self.DeclareStateOutputPort("command", self.DeclareDiscreteState(hover))
            if config.disturbance_time > 0.0:
                self.DeclareDiscreteState(6)
                self.DeclareInitializationDiscreteUpdateEvent(self._begin)
            self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)

        SetLookahead = parameter_setter("lookahead")
        SetMinThrust = parameter_setter("min_thrust")
        SetMaxThrust = parameter_setter("max_thrust")
        SetMaxTilt = parameter_setter("max_tilt")
        SetTiltGain = parameter_setter("tilt_gain")
        SetMaxTiltRate = parameter_setter("max_tilt_rate")
        SetYawGain = parameter_setter("yaw_gain")
        SetMaxYawRate = parameter_setter("max_yaw_rate")
        SetYawSpeed = parameter_setter("yaw_speed")
        SetDrag = parameter_setter("drag")
        SetGravity = parameter_setter("gravity")

        def _begin(self, context, discrete_state):
            v_WB = vector_input(self, "state", context)[3:6]
            if T is float and not np.isfinite(v_WB).all():  # of no vehicle yet
                v_WB = np.zeros(3)
            discrete_state.set_value(1, np.append(v_WB, np.zeros(3)))

        def _update(self, context, discrete_state):
            config, params = (each.config(context) for each in self._parameters)
            state = self._eval_finite("state", context)
            p_WB, v_WB, q_WB, _ = QuadrotorState.of(state)
            require_rotation(q_WB)
            use_waypoint = self.GetInputPort("waypoint").HasValue(context)
            if use_waypoint == self.GetInputPort("acceleration").HasValue(context):
                raise ValueError(
                    f"exactly one of 'waypoint' and 'acceleration' of '{self.get_name()}' must be "
                    f"connected, got {'both' if use_waypoint else 'neither'}"
                )
            heading = optional_input(self, "heading", context)
            heading = None if heading is None else heading[0]
            kind = "waypoint" if use_waypoint else "acceleration"
            target, disturbance = self._eval_finite(kind, context), None
            if config.disturbance_time > 0.0:
                old = context.get_discrete_state()
                observed = observe_disturbance(state, old.value(1), old.value(0)[0], config, params)
                discrete_state.set_value(1, observed)
                disturbance = observed[3:]
            # One native call, if it knows the case and the Context has the default parameters.
            if (
                T is float
                and (heading is None or math.isnan(heading))
                and (disturbance is None or not use_waypoint)
                and (config, params) == self._defaults
            ):
                command = np.empty(4)
                target = target if disturbance is None else target - disturbance
                _native.flight_command(kind, state, target, self._numbers, command)
                return discrete_state.set_value(0, command)
            a_WB, motion_W = target, v_WB
            if use_waypoint:
                a_WB = reaching_acceleration(target, p_WB, v_WB, config.lookahead)
                motion_W = (target - p_WB) / config.lookahead
            if disturbance is not None:
                a_WB = a_WB - disturbance
            # At rest arctan2 of AutoDiffXd warns of a division, and returns zero derivatives.
            with nullcontext() if T is float else np.errstate(divide="ignore"):
                command = flatness_command(state, a_WB, motion_W, heading, config, params)
            discrete_state.set_value(0, command)

        def _eval_finite(self, name, context):
            value = vector_input(self, name, context)
            require_finite(self.GetInputPort(name), context, float_values(value))
            return value

    return FlatnessController


FlatnessController = FlatnessController_[None]
