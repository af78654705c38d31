"""VelocitySetpoint: what a policy decides, for autopilots that are told velocities."""

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.policies.velocity_tracking import RESPONSE_TIME
from splatpilot.systems.ports import input_port, optional_input, output_port
from splatpilot.systems.vehicle.flatness import heading_along_motion
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


class VelocitySetpoint(LeafSystem):
    """Says at which velocity a policy's decision would be flown.

    .. pydrake_system::

        name: VelocitySetpoint
        input_ports:
        - state
        - waypoint
        - acceleration
        - velocity
        - heading
        output_ports:
        - velocity_setpoint

    - ``state`` (13), ``waypoint`` (3), ``acceleration`` (3), ``heading`` (1): those of
      :class:`~splatpilot.systems.vehicle.flatness_controller.FlatnessController`.
    - ``velocity`` (3): v [m/s], W frame. Connect exactly one of ``waypoint``, ``acceleration`` and
      ``velocity``.
    - ``velocity_setpoint`` (4): v [m/s], W frame, and the heading [rad].

    Stateless. Of the others, with T the time in which an autopilot takes a velocity up, and that to
    the waypoint::

        v = v_WB + T a_WB,  T = RESPONSE_TIME
        v = (p_WR - p_WB) / lookahead

    An autopilot keeps its heading where it is given none. Therefore a heading that is not connected
    or NaN becomes that along the motion, as the controller has it: toward the waypoint, else along
    v_WB, from the present heading as far as ``heading_along_motion`` says.
    """

    state_input_port = input_port("state")
    velocity_input_port = input_port("velocity")
    waypoint_input_port = input_port("waypoint")
    acceleration_input_port = input_port("acceleration")
    heading_input_port = input_port("heading")
    velocity_setpoint_output_port = output_port("velocity_setpoint")

    def __init__(self, controller: FlatnessControllerConfig):
        """Constructs the system; of the controller it has `lookahead` and `yaw_speed`."""
        super().__init__()
        self._lookahead, self._yaw_speed = controller.lookahead, controller.yaw_speed
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("waypoint", 3)
        self.DeclareVectorInputPort("acceleration", 3)
        self.DeclareVectorInputPort("velocity", 3)
        self.DeclareVectorInputPort("heading", 1)
        self.DeclareVectorOutputPort("velocity_setpoint", 4, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = QuadrotorState.of(np.asarray(self.GetInputPort("state").Eval(context)))
        velocity, waypoint, heading = (
            optional_input(self, name, context) for name in ("velocity", "waypoint", "heading")
        )
        motion_W = state.v_WB
        if velocity is None and waypoint is not None:
            velocity = motion_W = (waypoint - state.p_WB) / self._lookahead
        elif velocity is None:
            a_WB = np.asarray(self.GetInputPort("acceleration").Eval(context))
            velocity = state.v_WB + RESPONSE_TIME * a_WB
        if heading is None or math.isnan(heading[0]):
            along, fraction = heading_along_motion(motion_W, self._yaw_speed)
            heading = state.heading + fraction * math.remainder(along - state.heading, math.tau)
        output.SetFromVector(np.append(velocity, heading))
