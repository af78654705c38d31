"""VelocityTracker: from a wanted velocity to the acceleration that takes it up."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.policies.velocity_tracking import tracking_acceleration
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


class VelocityTracker(LeafSystem):
    """Does what an autopilot does that is told velocities.

    .. pydrake_system::

        name: VelocityTracker
        input_ports:
        - state
        - velocity
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``velocity`` (3): wanted v_WB [m/s], W frame.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.

    Stateless; the law is
    :func:`~splatpilot.systems.policies.velocity_tracking.tracking_acceleration`.
    """

    state_input_port = input_port("state")
    velocity_input_port = input_port("velocity")
    acceleration_output_port = output_port("acceleration")

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("velocity", 3)
        self.DeclareVectorOutputPort("acceleration", 3, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = QuadrotorState.of(np.asarray(self.GetInputPort("state").Eval(context)))
        wanted = np.asarray(self.GetInputPort("velocity").Eval(context))
        output.SetFromVector(tracking_acceleration(state.v_WB, wanted))
