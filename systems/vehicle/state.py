"""A quadrotor's state by name, its pose and prediction, and quaternions (wxyz)."""

import math
import sys
from types import ModuleType
from typing import Any, NamedTuple, Self

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.eigen_geometry import (
    Quaternion,
    Quaternion_,  # pyright: ignore[reportAttributeAccessIssue]
)
from pydrake.common.value import AbstractValue
from pydrake.math import (
    RigidTransform,
    RigidTransform_,  # pyright: ignore[reportAttributeAccessIssue]
    RotationMatrix,
)
from pydrake.systems.framework import (
    BasicVector,
    Context,
    LeafSystem,
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.drake import (
    is_autodiff,
    system_template,
    vector_input,
    weak_callback,
)
from splatpilot.systems.common.validation import require

LONGEST_PREDICTION = 0.1  # [s], maximum age of states that are predicted to the present.


class QuadrotorState(NamedTuple):
    """Parts of states (..., 13): numpy arrays (float, AutoDiffXd, Expression) or torch tensors."""

    p_WB: Any  # (..., 3) [m]
    v_WB: Any  # (..., 3) [m/s]
    q_WB: Any  # (..., 4), attitude as a quaternion w x y z.
    w_WB_B: Any  # (..., 3) [rad/s]

    @classmethod
    def of(cls, x: Any) -> Self:
        """Returns the parts of states x (..., 13), as views that write through."""
        require(x.shape[-1:] == (13,), "shape of states", "(..., 13)", tuple(x.shape))
        return cls(x[..., 0:3], x[..., 3:6], x[..., 6:10], x[..., 10:13])

    @property
    def tilt(self) -> np.ndarray:
        """(...) [rad], between body z and vertical, for numpy arrays of float."""
        w, x, y, z = np.moveaxis(self.q_WB, -1, 0)
        return np.arccos(np.clip(w * w - x * x - y * y + z * z, -1.0, 1.0))

    @property
    def heading(self) -> np.ndarray:
        """(...) [rad], of body x seen from above, for numpy arrays of float."""
        w, x, y, z = np.moveaxis(self.q_WB, -1, 0)
        return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)

    def to_vector(self) -> np.ndarray:
        """Returns the states (..., 13) of these parts, numpy arrays."""
        return np.concatenate(self, axis=-1)


def set_state(context: Context, state: np.ndarray) -> None:
    """Sets the first 13 continuous states of a plant's Context, those of its output ``state``."""
    vector = context.get_mutable_continuous_state_vector()
    for i, value in enumerate(state):
        vector.SetAtIndex(i, value)


def pose_from_state(state: np.ndarray) -> RigidTransform:
    """Returns X_WB of `state` (13,), see `make_pose`."""
    p_WB, _, q_WB, _ = QuadrotorState.of(state)
    return make_pose(p_WB, q_WB)


def make_pose(p_WB: np.ndarray, q_WB: np.ndarray) -> RigidTransform:
    """Returns X_WB of a position (3,) [m] and a quaternion (4,) of any length but zero; of
    AutoDiffXd if they are."""
    pose, quaternion = RigidTransform, Quaternion
    if is_autodiff(q_WB):
        pose, quaternion = RigidTransform_[AutoDiffXd], Quaternion_[AutoDiffXd]
    return pose(quaternion(q_WB / require_rotation(q_WB)), p_WB)


def require_rotation(q_WB: np.ndarray) -> Any:
    """Returns the length of a quaternion (4,); raises ValueError if it is zero or not finite."""
    norm = np.sqrt(q_WB.dot(q_WB))
    condition = "a rotation (w, x, y, z) in entries 6 to 9 of the state"
    require(
        1e-9 < norm < math.inf, "q_WB", condition, q_WB.tolist(), "check the estimator or plant"
    )
    return norm


def predict_state(state: np.ndarray, duration: float) -> np.ndarray:
    """Returns the state (13,) `duration` [s] later, at constant velocity and body rates."""
    p_WB, v_WB, q_WB, w_WB_B = QuadrotorState.of(state)
    R_WB = Rotation.from_quat(q_WB, scalar_first=True) * Rotation.from_rotvec(duration * w_WB_B)
    q = R_WB.as_quat(scalar_first=True)
    return QuadrotorState(p_WB + duration * v_WB, v_WB, q, w_WB_B).to_vector()


def pose_between(X_WC0: RigidTransform, X_WC1: RigidTransform, s: float) -> RigidTransform:
    """Returns the pose at the fraction s from X_WC0 to X_WC1: straight, about one axis."""
    rotation = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis()
    rotation.set_angle(s * rotation.angle())
    p_WC = (1.0 - s) * X_WC0.translation() + s * X_WC1.translation()
    return RigidTransform(X_WC0.rotation() @ RotationMatrix(rotation), p_WC)


def array_namespace(array: Any) -> ModuleType:
    """Returns the module whose functions take an array: numpy or torch."""
    torch = sys.modules.get("torch")  # A tensor can only come from an imported torch.
    return torch if torch is not None and isinstance(array, torch.Tensor) else np


def stack(parts: list) -> Any:
    """Stacks numbers or arrays along a new last axis; a list of rows along two."""
    rows = isinstance(parts[0], list)
    first = parts[0][0] if rows else parts[0]
    if np.ndim(first) == 0 and array_namespace(first) is np:
        return np.array(parts)  # numpy's stack costs several times as much on single numbers
    arrays = [stack(row) for row in parts] if rows else parts
    return array_namespace(first).stack(arrays, -2 if rows else -1)


def clip(x: Any, low: float | None = None, high: float | None = None) -> Any:
    """Clips as `numpy.clip`, which costs several times as much on single numbers."""
    if array_namespace(x) is not np:
        return x.clip(low, high)
    x = x if low is None else np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


def lengths(vectors: Any) -> Any:
    """Returns the lengths (..., 1) of vectors (..., n), with zero gradient at zero."""
    xp = array_namespace(vectors)
    if xp is np:
        return np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return xp.linalg.vector_norm(vectors, dim=-1, keepdim=True)


def unit_vectors(vectors: Any) -> Any:
    """Returns vectors (..., n) at unit length; zero stays zero."""
    return vectors / clip(lengths(vectors), low=1e-12)


def rotation_matrices(q: Any) -> Any:
    """Returns the rotation matrices (..., 3, 3) of quaternions (..., 4) wxyz of any length."""
    q = unit_vectors(q)
    w, x, y, z = (q[..., i] for i in range(4))
    return stack(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@system_template("StateToPose_")
def StateToPose_(T):
    class StateToPose(LeafSystem_[T]):
        """Outputs the ``pose`` X_WB (RigidTransform) of a ``state`` (13), see `pose_from_state`.

        Supports the scalars float and AutoDiffXd.
        """

        def __init__(self, *, converter: Any = None):
            super().__init__(converter=converter)
            state = self.DeclareVectorInputPort("state", 13)
            self.DeclareAbstractOutputPort(
                "pose",
                lambda: AbstractValue.Make(RigidTransform_[T]()),
                weak_callback(self._calc_pose),
                {state.ticket()},
            )

        def _calc_pose(self, context, output):
            output.set_value(pose_from_state(vector_input(self, "state", context)))

    return StateToPose


StateToPose = StateToPose_[None]


class StatePredictor(LeafSystem):
    """Predicts a measured state to the present, see `predict_state`.

    .. pydrake_system::

        name: StatePredictor
        input_ports: [measured_state, age]
        output_ports: [state]

    - ``measured_state`` (13), ``state`` (13): as those of `QuadrotorPlant`.
    - ``age`` (1): [s] since it was measured, clipped to [0, ``longest``] against clocks that
      disagree and vehicles that fell silent.
    """

    def __init__(self, longest: float = LONGEST_PREDICTION):
        super().__init__()
        self._longest = longest
        self.DeclareVectorInputPort("measured_state", 13)
        self.DeclareVectorInputPort("age", 1)
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = vector_input(self, "measured_state", context)
        age = float(vector_input(self, "age", context)[0])
        output.SetFromVector(predict_state(state, min(max(age, 0.0), self._longest)))
