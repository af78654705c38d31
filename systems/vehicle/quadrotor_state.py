"""The 13 numbers of a quadrotor's state, by name."""

from typing import Any, NamedTuple, Self

import numpy as np


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
