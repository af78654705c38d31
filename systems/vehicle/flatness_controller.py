"""Flight control by differential flatness."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.ports import input_port, optional_input, output_port
from splatpilot.systems.vehicle.flatness import (
    attitude_error,
    attitude_from_thrust,
    heading_along_motion,
    limit_norm,
    limit_thrust,
    reaching_acceleration,
    thrust_for_acceleration,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


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
