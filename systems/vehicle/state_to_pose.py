"""The pose within a quadrotor's state."""

import math

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.weakly import weakly


def pose_from_state(state: np.ndarray) -> RigidTransform:
    """X_WB of ``state`` (13,), its quaternion normalised.

    Raises:
        ValueError: if the quaternion is zero or not finite.
    """
    p_WB, _, q_WB, _ = QuadrotorState.of(state)
    norm = math.sqrt(q_WB.dot(q_WB))
    if not 1e-9 < norm < math.inf:
        raise ValueError(
            f"the attitude quaternion q_WB = {q_WB.tolist()} has length {norm} and is no rotation; "
            "set entries 6 to 9 of the state to a unit quaternion (w, x, y, z)"
        )
    return RigidTransform(Quaternion(q_WB / norm), p_WB)


class StateToPose(LeafSystem):
    """Extracts the pose X_WB from a quadrotor's state.

    .. pydrake_system::

        name: StateToPose
        input_ports:
        - state
        output_ports:
        - pose

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``pose`` (abstract, RigidTransform): X_WB; the quaternion is normalised first.

    Evaluating ``pose`` raises ValueError if the quaternion is zero or not finite.
    """

    state_input_port = input_port("state")
    pose_output_port = output_port("pose")

    def __init__(self):
        super().__init__()
        state = self.DeclareVectorInputPort("state", 13)
        self.DeclareAbstractOutputPort(
            "pose", lambda: Value(RigidTransform()), weakly(self._calc_pose), {state.ticket()}
        )

    def _calc_pose(self, context, output):
        state = np.asarray(self.get_input_port().Eval(context))
        output.set_value(pose_from_state(state))
