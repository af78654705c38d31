"""Between our frames and those of PX4 and of motion capture; nothing else converts them.

Ours are the world W, z up, and the body B: x forward, y left, z up. PX4's are its local frame, x
north, y east, z down, and the body x forward, y right, z down. W is the local frame turned by half
a turn about its x axis: x north, y west. OptiTrack's world and bodies, y up: x north, y up, z east.
"""

import numpy as np

_HALF_TURN = np.array([1.0, -1.0, -1.0])
"""From either of our frames to PX4's, and back."""


def to_px4(v: np.ndarray) -> np.ndarray:
    """A vector (3,) in W or B as PX4 has it, in its local frame or its body's."""
    return _HALF_TURN * v


def from_px4(v: np.ndarray) -> np.ndarray:
    """A vector (3,) in PX4's local frame or its body's, in W or B."""
    return _HALF_TURN * v


def attitude_to_px4(q_WB: np.ndarray) -> np.ndarray:
    """The attitude (4, wxyz) of PX4's body in its local frame, of ours in W."""
    return np.append(q_WB[0], to_px4(q_WB[1:]))


def attitude_from_px4(q: np.ndarray) -> np.ndarray:
    """The attitude q_WB (4, wxyz), of that of PX4's body in its local frame."""
    return np.append(q[0], from_px4(q[1:]))


def heading_to_px4(heading: float) -> float:
    """The yaw [rad], clockwise from north, of a heading, counterclockwise from x of W."""
    return -heading


def from_optitrack(v: np.ndarray) -> np.ndarray:
    """A position (3,) in OptiTrack's world, y up, in W."""
    x, y, z = v
    return np.array([x, -z, y])


def attitude_from_optitrack(q: np.ndarray) -> np.ndarray:
    """The attitude q_WB (4, wxyz) of a body that OptiTrack sees at q (4, xyzw), y up."""
    return np.append(q[3], from_optitrack(q[:3]))


def thrust_to_px4(thrust: float, hover_thrust: float, gravity: float) -> float:
    """
    Thrust from 0 to 1 of a thrust over mass [m/s^2].

    Args:
        hover_thrust: that carries the weight, as PX4's MPC_THR_HOVER.
        gravity: [m/s^2].
    """
    return min(max(hover_thrust * thrust / gravity, 0.0), 1.0)
