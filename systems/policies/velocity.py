"""Tracking of desired velocities, and velocity setpoints for autopilots."""

import math
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    LeafSystem,
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)

from splatpilot.systems.common.drake import optional_input, system_template, vector_input
from splatpilot.systems.common.validation import require_type
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, heading_along_motion
from splatpilot.systems.vehicle.state import QuadrotorState, array_namespace, clip

SLOWING_TIME = 0.75  # [s] for `target_velocity`, of classical policies
RESPONSE_TIME = 0.4  # [s] time constant of velocity tracking; that of the attitude is 0.1 s
MAX_ACCELERATION = 6.0  # [m/s^2] of velocity tracking, a tilt of 31 degrees


def tracking_acceleration(v_WB: Any, v_desired: Any) -> Any:
    """Computes a_WB (..., 3) [m/s^2] by which v_WB approaches `v_desired` [m/s] exponentially:
    (v_desired - v_WB) / 0.4 s, shortened to 6 m/s^2. Arrays are numpy, of AutoDiffXd too, or
    torch."""
    a = (v_desired - v_WB) / RESPONSE_TIME
    size = array_namespace(a).sqrt(clip((a * a).sum(-1, keepdims=True), low=1e-12))
    return a * clip(MAX_ACCELERATION / size, high=1.0)


@system_template("VelocityTracker_")
def VelocityTracker_(T):
    class VelocityTracker(LeafSystem_[T]):
        """Tracks velocities as an autopilot does, by `tracking_acceleration`.

        .. pydrake_system::

            name: VelocityTracker
            input_ports: [state, velocity]
            output_ports: [acceleration]

        - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
        - ``velocity`` (3): desired v_WB [m/s], W frame.
        - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.

        Supports the scalars float and AutoDiffXd.
        """

        def __init__(self, *, converter: Any = None) -> None:
            super().__init__(converter=converter)
            self.DeclareVectorInputPort("state", 13)
            self.DeclareVectorInputPort("velocity", 3)
            inputs = {self.all_input_ports_ticket()}
            self.DeclareVectorOutputPort("acceleration", 3, self._calc, inputs)

        def _calc(self, context, output):
            state = QuadrotorState.of(vector_input(self, "state", context))
            v_desired = vector_input(self, "velocity", context)
            output.SetFromVector(tracking_acceleration(state.v_WB, v_desired))

    return VelocityTracker


VelocityTracker = VelocityTracker_[None]


class VelocitySetpoint(LeafSystem):
    """Converts a policy's output to the velocity and heading of an autopilot.

    .. pydrake_system::

        name: VelocitySetpoint
        input_ports: [state, waypoint, acceleration, velocity, heading]
        output_ports: [velocity_setpoint]

    - ``state`` (13), ``waypoint`` (3), ``acceleration`` (3), ``heading`` (1): those of
      :class:`~splatpilot.systems.vehicle.flatness.FlatnessController`.
    - ``velocity`` (3): v [m/s], W frame. Connect exactly one of ``waypoint``, ``acceleration`` and
      ``velocity``.
    - ``velocity_setpoint`` (4): v [m/s], W frame, and the heading [rad].

    Accelerations and waypoints become::

        v = v_WB + RESPONSE_TIME a_WB
        v = (p_WR - p_WB) / lookahead

    If ``heading`` is not connected or NaN, the heading follows the motion as in the controller, by
    ``heading_along_motion``: toward the waypoint, else along v_WB.

    Args:
        controller: its `lookahead` and `yaw_speed` are used.
    """

    def __init__(self, controller: FlatnessControllerConfig):
        super().__init__()
        require_type(controller, FlatnessControllerConfig, "controller")
        self._lookahead, self._yaw_speed = controller.lookahead, controller.yaw_speed
        sizes = {"state": 13, "waypoint": 3, "acceleration": 3, "velocity": 3, "heading": 1}
        for name, size in sizes.items():
            self.DeclareVectorInputPort(name, size)
        inputs = {self.all_input_ports_ticket()}
        self.DeclareVectorOutputPort("velocity_setpoint", 4, self._calc, inputs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = QuadrotorState.of(vector_input(self, "state", context))
        velocity, waypoint, heading = (
            optional_input(self, name, context) for name in ("velocity", "waypoint", "heading")
        )
        motion_W = state.v_WB
        if velocity is None and waypoint is not None:
            velocity = motion_W = (waypoint - state.p_WB) / self._lookahead
        elif velocity is None:
            a_WB = vector_input(self, "acceleration", context)
            velocity = state.v_WB + RESPONSE_TIME * a_WB
        if heading is None or math.isnan(heading[0]):
            along, fraction = heading_along_motion(motion_W, self._yaw_speed)
            heading = state.heading + fraction * math.remainder(along - state.heading, math.tau)
        output.SetFromVector(np.append(velocity, heading))
