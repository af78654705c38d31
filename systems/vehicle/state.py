"""The 13 numbers of a quadrotor's state, by name."""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.common.drake import input_port, output_port, weakly


class QuadrotorState(NamedTuple):
    """States (..., 13) in their parts, which are numpy arrays (of float, AutoDiffXd or Expression)
    or torch tensors."""

    p_WB: Any
    """(..., 3) [m], position in the world."""
    v_WB: Any
    """(..., 3) [m/s], velocity in the world."""
    q_WB: Any
    """(..., 4), attitude as a quaternion w x y z."""
    w_WB_B: Any
    """(..., 3) [rad/s], angular velocity in the body frame."""

    @classmethod
    def of(cls, x: Any) -> Self:
        """The parts of states x (..., 13), as views: what is written to them is written to x.

        Raises:
            ValueError: if x has another shape.
        """
        if x.shape[-1:] != (13,):
            raise ValueError(f"a state has shape {tuple(x.shape)}; it must be (..., 13)")
        return cls(x[..., 0:3], x[..., 3:6], x[..., 6:10], x[..., 10:13])

    @property
    def tilt(self) -> np.ndarray:
        """(...) [rad], between body z and vertical, of parts that are numpy arrays of float."""
        w, x, y, z = np.moveaxis(self.q_WB, -1, 0)
        return np.arccos(np.clip(w * w - x * x - y * y + z * z, -1.0, 1.0))

    @property
    def heading(self) -> np.ndarray:
        """(...) [rad], of body x seen from above, of parts that are numpy arrays of float."""
        w, x, y, z = np.moveaxis(self.q_WB, -1, 0)
        return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)

    def to_vector(self) -> np.ndarray:
        """The states (..., 13) of these parts, numpy arrays."""
        return np.concatenate(self, axis=-1)


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


LONGEST_PREDICTION = 0.1
"""[s], how old states can be brought up to date."""


def predict_state(state: np.ndarray, duration: float) -> np.ndarray:
    """The state (13,) `duration` [s] later, if neither velocity nor body rates change meanwhile."""
    p_WB, v_WB, q_WB, w_WB_B = QuadrotorState.of(state)
    half = 0.5 * duration * w_WB_B
    angle = math.hypot(*half)
    turn = np.append(math.cos(angle), half * (np.sinc(angle / math.pi)))
    s, v, t, u = q_WB[0], q_WB[1:], turn[0], turn[1:]
    q = np.append(s * t - v.dot(u), s * u + t * v + np.cross(v, u))
    return QuadrotorState(p_WB + duration * v_WB, v_WB, q, w_WB_B).to_vector()


class StatePredictor(LeafSystem):
    """Brings a measured state up to date, see `predict_state`.

    .. pydrake_system::

        name: StatePredictor
        input_ports:
        - measured_state
        - age
        output_ports:
        - state

    - ``measured_state`` (13), ``state`` (13): as those of
      :class:`~splatpilot.systems.vehicle.quadrotor.QuadrotorPlant`.
    - ``age`` (1): [s] since it was measured; it counts for 0 to ``longest``, so that neither clocks
      that disagree nor a vehicle that fell silent lead far away.

    Stateless.
    """

    measured_state_input_port = input_port("measured_state")
    age_input_port = input_port("age")
    state_output_port = output_port("state")

    def __init__(self, longest: float = LONGEST_PREDICTION):
        """Constructs the system; `longest` is how far it predicts [s]."""
        super().__init__()
        self._longest = longest
        self.DeclareVectorInputPort("measured_state", 13)
        self.DeclareVectorInputPort("age", 1)
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = np.asarray(self.GetInputPort("measured_state").Eval(context))
        age = float(np.asarray(self.GetInputPort("age").Eval(context))[0])
        output.SetFromVector(predict_state(state, min(max(age, 0.0), self._longest)))


def pose_between(X_WC0: RigidTransform, X_WC1: RigidTransform, s: float) -> RigidTransform:
    """The pose at the fraction s of the way from X_WC0 to X_WC1: along the line between the
    positions, and turned about one axis."""
    turn = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis()
    turn.set_angle(s * turn.angle())
    p_WC = (1.0 - s) * X_WC0.translation() + s * X_WC1.translation()
    return RigidTransform(X_WC0.rotation() @ RotationMatrix(turn), p_WC)
