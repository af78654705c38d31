"""Differential flatness of the quadrotor: from a wanted acceleration to thrust and body rates.

A quadrotor's position and yaw determine its attitude: the specific thrust must supply the wanted
acceleration, carry the weight and overcome drag, so its direction is the body z axis, and yaw
fixes the rest (D. Mellinger and V. Kumar, "Minimum snap trajectory generation and control for
quadrotors", ICRA 2011; with drag: M. Faessler, A. Franchi and D. Scaramuzza, "Differential flatness
of quadrotor dynamics subject to rotor drag", RA-L 2018). The attitude is then reached by turning
the body z axis along the shortest way first and yaw at leisure, since only the former moves the
vehicle (D. Brescianini and R. D'Andrea, "Tilt-prioritized quadrocopter attitude control", T-CST
2018).

Frames: W world, B body, D the desired body. Vectors are numpy arrays of shape (3,). Thrust is over
mass [m/s^2], angles in rad.
"""

import math
import sys
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.common.drake import input_port, optional_input, output_port
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

_TINY = 1e-9  # Below this length a unit vector's direction is meaningless.


def reaching_acceleration(
    p_WR: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, lookahead: float
) -> np.ndarray:
    """The constant acceleration [m/s^2] that takes the vehicle to p_WR [m] in ``lookahead`` [s].

    a = 2 (p_WR - p_WB - T v_WB) / T². Applied continually with p_WR(t) = r(t + T), it makes p_WB
    follow r with the transfer function e^x / (1 + x + x²/2), x = sT: an error of third order in T,
    damped at 1/√2. A lag of T/3 between wanted and actual acceleration removes the third order too.
    """
    return 2.0 * (p_WR - p_WB - lookahead * v_WB) / lookahead**2


def thrust_for_acceleration(
    a_WB: np.ndarray, v_WB: np.ndarray, drag: float, gravity: float
) -> np.ndarray:
    """The specific thrust in W [m/s^2] under which the vehicle accelerates with a_WB.

    f = a_WB + g e_z + drag v_WB, the translational dynamics solved for the thrust.
    """
    f_W = a_WB + drag * v_WB
    f_W[2] += gravity
    return f_W


def limit_thrust(
    f_W: np.ndarray, min_thrust: float, max_thrust: float, max_tilt: float
) -> np.ndarray:
    """``f_W`` brought within ``max_tilt`` [rad] of vertical and the thrust range [m/s^2].

    The vertical part is kept and the horizontal part shortened to respect the tilt; only then is
    the whole shortened to ``max_thrust``. A vertical part below ``min_thrust``, pointing down for
    instance, becomes ``min_thrust``.
    """
    fx, fy, fz = f_W.tolist()
    fz = max(fz, min_thrust)
    horizontal = math.hypot(fx, fy)
    widest = fz * math.tan(max_tilt)
    if horizontal > widest:
        fx, fy = fx * widest / horizontal, fy * widest / horizontal
    shrink = min(1.0, max_thrust / max(math.hypot(fx, fy, fz), _TINY))
    return np.array([shrink * fx, shrink * fy, shrink * fz])


def attitude_from_thrust(f_W: np.ndarray, yaw: float) -> np.ndarray:
    """R_WD (3, 3): body z along ``f_W``, and body x pointing where ``yaw`` [rad] says.

    Seen from above, body x points exactly along ``yaw``: it is perpendicular to the horizontal
    left-hand direction. Where that is undefined, in a body rolled by 90 deg, it comes closest to
    the heading. Zero thrust gives the level attitude.
    """
    norm = math.sqrt(f_W.dot(f_W))
    z_W = f_W / norm if norm > _TINY else np.array([0.0, 0.0, 1.0])
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    zx, zy, zz = z_W.tolist()

    x_W = np.array([cos_yaw * zz, sin_yaw * zz, -sin_yaw * zy - cos_yaw * zx])  # left × z
    length = math.sqrt(x_W.dot(x_W))
    if length > 1e-3:
        x_W = x_W / math.copysign(length, zz)
    else:
        y_W = np.array([-zz * sin_yaw, zz * cos_yaw, zx * sin_yaw - zy * cos_yaw])  # z × heading
        x_W = cross(y_W / math.sqrt(y_W.dot(y_W)), z_W)
    return np.column_stack((x_W, cross(z_W, x_W), z_W))


def heading_along_motion(motion_W: np.ndarray, full_speed: float) -> tuple[float, float]:
    """Returns the heading [rad] of a motion (3,) [m/s] and how far to turn to it, from 0 to 1.

    The fraction falls as the square of the horizontal speed below `full_speed` [m/s], so that a
    hovering vehicle does not turn after noise.
    """
    fraction = min(1.0, math.hypot(motion_W[0], motion_W[1]) / full_speed)
    return math.atan2(motion_W[1], motion_W[0]), fraction**2


def attitude_error(R_WB: np.ndarray, R_WD: np.ndarray) -> tuple[np.ndarray, float]:
    """The turn from B to D as ``(tilt_B (2,), yaw)`` [rad].

    First the body turns by |tilt_B| about the axis tilt_B in its own x-y plane, the shortest turn
    that brings its z axis to D's; then by ``yaw`` about that z axis. With z_B opposite to z_D,
    where every axis is as short, it turns about body x.
    """
    R_BD = R_WB.T @ R_WD
    (x1, _, z1), (x2, _, z2), (x3, _, z3) = R_BD.tolist()
    sine = math.hypot(z1, z2)
    angle = math.atan2(sine, z3)
    n1, n2 = (-z2 / sine, z1 / sine) if sine > _TINY else (1.0, 0.0)

    # D's x axis seen from the tilted body: e_x and e_y turned about n, against column x of R_BD.
    cosine, sine = math.cos(angle), math.sin(angle)
    along = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + along * n1
    left = cosine * x2 + sine * n1 * x3 + along * n2
    return np.array([angle * n1, angle * n2]), math.atan2(left, ahead)


def limit_norm(vector: np.ndarray, limit: float) -> np.ndarray:
    """``vector`` (n,), shortened to length ``limit`` if it is longer."""
    norm = math.sqrt(vector.dot(vector))
    return vector * (limit / norm) if norm > limit else vector


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b, (3,) each; np.cross costs twenty times as much on single vectors."""
    a1, a2, a3 = a.tolist()
    b1, b2, b3 = b.tolist()
    return np.array([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])


@dataclass
class FlatnessControllerConfig:
    """Gains and limits of the controller."""

    # [s] Time between updates.
    period: float = 0.02
    # [s] How far ahead of now the waypoint lies. At three times the attitude's lag, 3 / tilt_gain,
    # that lag cancels the leading tracking error; longer is smoother, shorter stiffer.
    lookahead: float = 0.4
    # [m/s^2] Least thrust over mass.
    min_thrust: float = 2.0
    # [m/s^2] Greatest thrust over mass.
    max_thrust: float = 20.0
    # [rad] Greatest commanded angle between body z and vertical.
    max_tilt: float = 0.8
    # [1/s] Commanded roll and pitch rate per angle of tilt error.
    tilt_gain: float = 10.0
    # [rad/s] Greatest commanded rate about an axis in the body's x-y plane.
    max_tilt_rate: float = 6.0
    # [1/s] Commanded yaw rate per angle of yaw error.
    yaw_gain: float = 3.0
    # [rad/s] Greatest commanded yaw rate.
    max_yaw_rate: float = 2.0
    # [m/s] Horizontal speed from which yaw follows the motion fully; below, the pull falls as the
    # square, so that a hovering vehicle does not turn after noise.
    yaw_speed: float = 0.5

    def validate(self, gravity: float) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy.

        All must be positive and finite, period at least 1e-4, min_thrust < max_thrust,
        max_tilt < pi/2, the vertical part of max_thrust at max_tilt above ``gravity`` [m/s^2], and
        lookahead at least 2 / tilt_gain.
        """
        name = "FlatnessControllerConfig"
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < math.inf:
                raise ValueError(
                    f"{name}.{field.name} is {value} but must be positive and finite; "
                    f"the default is {field.default}"
                )
        if self.period < 1e-4:
            raise ValueError(
                f"{name}.period is {self.period} s but must be at least 1e-4; the default is "
                f"{FlatnessControllerConfig.period}"
            )
        if self.min_thrust >= self.max_thrust:
            raise ValueError(
                f"{name}.min_thrust is {self.min_thrust} m/s^2 but must be below max_thrust, "
                f"{self.max_thrust}; lower one or raise the other"
            )
        if self.max_tilt >= math.pi / 2:
            raise ValueError(
                f"{name}.max_tilt is {self.max_tilt} rad but must be below pi/2; "
                f"use at most {math.acos(min(1.0, gravity / self.max_thrust)):.2f}"
            )
        if self.max_thrust * math.cos(self.max_tilt) <= gravity:
            raise ValueError(
                f"{name}.max_thrust is {self.max_thrust} m/s^2 but must exceed "
                f"{gravity / math.cos(self.max_tilt):.2f} to carry the weight at max_tilt = "
                f"{self.max_tilt} rad; raise it or lower max_tilt"
            )
        if self.lookahead * self.tilt_gain < 2.0:
            raise ValueError(
                f"{name}.lookahead is {self.lookahead} s but must be at least 2 / tilt_gain = "
                f"{2.0 / self.tilt_gain:.3g} s, or the attitude is too slow to follow; "
                "raise lookahead or tilt_gain"
            )


def flatness_command(
    state: np.ndarray,
    a_WB: np.ndarray,
    motion_W: np.ndarray,
    heading: float,
    config: FlatnessControllerConfig,
    params: QuadrotorParams,
) -> np.ndarray:
    """Thrust over mass and body rates (4,) that fly an acceleration, see `FlatnessController`.

    Args:
        state: (13,).
        a_WB: (3,) [m/s^2], gravity excluded.
        motion_W: (3,) [m/s], along which the vehicle looks where the heading is NaN.
        heading: [rad], or NaN.
    """
    R_WB = pose_from_state(state).rotation().matrix()
    f_W = thrust_for_acceleration(a_WB, QuadrotorState.of(state).v_WB, params.drag, params.gravity)
    f_W = limit_thrust(f_W, config.min_thrust, config.max_thrust, config.max_tilt)
    pull = 1.0
    if math.isnan(heading):
        heading, pull = heading_along_motion(motion_W, config.yaw_speed)
    tilt_B, yaw = attitude_error(R_WB, attitude_from_thrust(f_W, heading))
    yaw *= pull

    command = np.empty(4)
    command[0] = min(max(f_W.dot(R_WB[:, 2]), config.min_thrust), config.max_thrust)
    command[1:3] = limit_norm(config.tilt_gain * tilt_B, config.max_tilt_rate)
    command[3] = min(max(config.yaw_gain * yaw, -config.max_yaw_rate), config.max_yaw_rate)
    return command


class FlatnessController(LeafSystem):
    """Flies a quadrotor to a moving waypoint, or with an acceleration, by thrust and body rates.

    .. pydrake_system::

        name: FlatnessController
        input_ports:
        - state
        - waypoint
        - acceleration
        - heading
        output_ports:
        - command

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``waypoint`` (3): p_WR [m], where the vehicle should be ``lookahead`` seconds from now.
    - ``acceleration`` (3): a_WB [m/s^2], the acceleration wanted, gravity excluded.
    - ``heading`` (1), optional: where body x should point, seen from above, [rad] from world x;
      along the motion where it is not connected or NaN.
    - ``command`` (4): ``[c [m/s^2], w_cmd_B (3) [rad/s]]``, held between updates; hover thrust
      before the first.

    Connect exactly one of ``waypoint`` and ``acceleration``. Updates every ``period`` seconds from
    time 0. With z_B the body z axis and limits applied to every step::

        a_WB    = 2 (p_WR - p_WB - T v_WB) / T²
        f_W     = a_WB + g e_z + drag v_WB
        c       = f_W · z_B
        w_cmd_B = [tilt_gain · tilt, yaw_gain · yaw]

    where tilt and yaw turn the body so that z lies along f_W and x to the heading or along the
    motion: towards the waypoint, or along v_WB when an acceleration is flown. See
    :mod:`~splatpilot.systems.vehicle.flatness`.

    Raises:
        ValueError: from the constructor on a config or parameter out of range; from an update if
            none or both of the alternative inputs are connected, or if an input is not finite.
    """

    state_input_port = input_port("state")
    waypoint_input_port = input_port("waypoint")
    acceleration_input_port = input_port("acceleration")
    heading_input_port = input_port("heading")
    command_output_port = output_port("command")

    def __init__(
        self,
        config: FlatnessControllerConfig | None = None,
        params: QuadrotorParams | None = None,
    ):
        super().__init__()
        self._config = replace(config or FlatnessControllerConfig())
        self._params = replace(params or QuadrotorParams())
        self._params.validate()
        self._config.validate(self._params.gravity)
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("waypoint", 3)
        self.DeclareVectorInputPort("acceleration", 3)
        self.DeclareVectorInputPort("heading", 1)
        command = self.DeclareDiscreteState(np.array([self._params.gravity, 0.0, 0.0, 0.0]))
        self.DeclareStateOutputPort("command", command)
        self.DeclarePeriodicDiscreteUpdateEvent(self._config.period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        config = self._config
        state = self._eval_finite("state", context)
        p_WB, v_WB, _, _ = QuadrotorState.of(state)

        use_waypoint = self.GetInputPort("waypoint").HasValue(context)
        if use_waypoint == self.GetInputPort("acceleration").HasValue(context):
            count = "both are" if use_waypoint else "neither is"
            raise ValueError(
                f"FlatnessController '{self.get_name()}': of the inputs 'waypoint' and "
                f"'acceleration' {count} connected; connect exactly one"
            )
        if use_waypoint:
            p_WR = self._eval_finite("waypoint", context)
            a_WB = reaching_acceleration(p_WR, p_WB, v_WB, config.lookahead)
            motion_W = (p_WR - p_WB) / config.lookahead
        else:
            a_WB = self._eval_finite("acceleration", context)
            motion_W = v_WB

        heading = self._heading(context)
        discrete_state.set_value(
            flatness_command(state, a_WB, motion_W, heading, config, self._params)
        )

    def _heading(self, context: Context) -> float:
        """The heading asked for [rad], or NaN."""
        heading = optional_input(self, "heading", context)
        return math.nan if heading is None else float(heading[0])

    def _eval_finite(self, name: str, context: Context) -> np.ndarray:
        value = np.asarray(self.GetInputPort(name).Eval(context))
        if not np.isfinite(value).all():
            raise ValueError(
                f"FlatnessController '{self.get_name()}': input '{name}' is {value.tolist()} at "
                f"t = {context.get_time()} s but must be finite; look at what "
                "gives it, in flights the policy"
            )
        return value


# The law of `FlatnessController` for many vehicles at once.
#
# The same formulas serve numpy arrays and torch tensors, differentiable as these are, so that
# flights that only gather data need no torch and fly as those that are trained through. Single
# vehicles have the law in `flatness`, on floats.


def flatness_commands(
    state: Any,
    a_WB: Any,
    control: FlatnessControllerConfig,
    params: QuadrotorParams,
    heading: Any = None,
) -> Any:
    """Thrust over mass and body rates (N, 4) that fly accelerations, see `FlatnessController`.

    Args:
        state: (N, 13).
        a_WB: (N, 3) [m/s^2], gravity excluded.
        control: the controller's constants.
        params: of the vehicles.
        heading: (N,) [rad], where they look; None: along their velocity.
    """
    xp = array_namespace(state)
    _, v, q_WB, _ = QuadrotorState.of(state)
    f = a_WB + params.drag * v
    level, lift = f[:, :2], (f[:, 2:] + params.gravity).clip(min=control.min_thrust)
    widest = lift * math.tan(control.max_tilt)
    level = level * (widest / lengths(level).clip(min=1e-6)).clip(max=1.0)
    f = xp.concatenate([level, lift], 1)
    f = f * (control.max_thrust / lengths(f)).clip(max=1.0)

    R_WB = rotation_matrices(q_WB)
    heading, pull = headings_and_pulls(v, control, heading)
    R_BD = R_WB.mT @ attitudes_from_thrust(f, heading)
    # First the shortest turn of the body's z axis, about n in its x-y plane, then yaw.
    z1, z2, z3 = (R_BD[:, i, 2] for i in range(3))
    sine = xp.sqrt(z1 * z1 + z2 * z2 + 1e-12)
    angle = xp.arctan2(sine, z3)
    n1, n2 = -z2 / sine, z1 / sine
    rates = control.tilt_gain * xp.stack([angle * n1, angle * n2], 1)
    rates = rates * (control.max_tilt_rate / lengths(rates).clip(min=1e-6)).clip(max=1.0)
    x1, x2, x3 = (R_BD[:, i, 0] for i in range(3))
    cosine, sine = xp.cos(angle), xp.sin(angle)
    along = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + along * n1
    left = cosine * x2 + sine * n1 * x3 + along * n2
    yaw = control.yaw_gain * pull * xp.arctan2(left, ahead)
    yaw = yaw.clip(min=-control.max_yaw_rate, max=control.max_yaw_rate)
    thrust = (f * R_WB[:, :, 2]).sum(1).clip(min=control.min_thrust, max=control.max_thrust)
    return xp.concatenate([thrust[:, None], rates, yaw[:, None]], 1)


def headings_and_pulls(v: Any, control: FlatnessControllerConfig, heading: Any) -> tuple[Any, Any]:
    """Where to look (N,) [rad], `heading` or along the velocity v (N, 3), and how strongly (N,),
    0 to 1."""
    xp = array_namespace(v)
    if heading is not None:
        return heading, xp.ones_like(heading)
    pull = (lengths(v[:, :2])[:, 0] / control.yaw_speed).clip(max=1.0)
    return xp.arctan2(v[:, 1], v[:, 0]), pull * pull


def attitudes_from_thrust(f: Any, yaw: Any) -> Any:
    """R_WB (N, 3, 3) with z along f (N, 3), upwards, and x above the direction of yaw (N,)."""
    xp = array_namespace(f)
    z = unit_vectors(f)
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x = xp.stack([cos * z[:, 2], sin * z[:, 2], -sin * z[:, 1] - cos * z[:, 0]], 1)
    x = unit_vectors(x)
    return xp.stack([x, _cross(z, x), z], 2)


def rotation_matrices(q: Any) -> Any:
    """The rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any length."""
    xp = array_namespace(q)
    w, x, y, z = unit_vectors(q).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return xp.stack(rows, 1).reshape(-1, 3, 3)


def lengths(vectors: Any) -> Any:
    """Lengths (N, 1) of vectors (N, n); of tensors with gradient zero where they are zero."""
    xp = array_namespace(vectors)
    if xp is np:
        return np.sqrt((vectors * vectors).sum(1, keepdims=True))
    return xp.linalg.vector_norm(vectors, dim=1, keepdim=True)


def unit_vectors(vectors: Any) -> Any:
    """Vectors (N, n) at unit length; zero stays zero."""
    return vectors / lengths(vectors).clip(min=1e-12)


def _cross(a: Any, b: Any) -> Any:
    """a x b, (N, 3) each; numpy's own costs ten times as much on few."""
    xp = array_namespace(a)
    if xp is not np:
        return xp.linalg.cross(a, b)
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return np.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], 1)


def array_namespace(array: Any) -> ModuleType:
    """The module whose functions an array takes: numpy or torch."""
    torch = sys.modules.get("torch")  # A tensor can only come from a torch already imported.
    return torch if torch is not None and isinstance(array, torch.Tensor) else np
