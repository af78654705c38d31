"""Conversion between our frames and those of PX4 and OptiTrack; the one place that converts them.

Ours are the world W, z up, and the body B: x forward, y left, z up. PX4's are its local frame, x
north, y east, z down, and the body x forward, y right, z down. W is the local frame rotated by half
a turn about its x axis: x north, y west. OptiTrack's world and bodies, y up: x north, y up, z east.
"""

import numpy as np

_HALF_TURN = np.array([1.0, -1.0, -1.0])


def swap_px4(v: np.ndarray) -> np.ndarray:
    """Converts a vector (3,) between W or B and PX4's local or body frame, in either direction."""
    return _HALF_TURN * v


def swap_px4_attitude(q: np.ndarray) -> np.ndarray:
    """Converts an attitude (4, wxyz) between W and PX4's local frame, in either direction."""
    return np.append(q[0], swap_px4(q[1:]))


def from_optitrack(v: np.ndarray) -> np.ndarray:
    """Converts a position (3,) from OptiTrack's world, y up, to W."""
    x, y, z = v
    return np.array([x, -z, y])


def attitude_from_optitrack(q: np.ndarray) -> np.ndarray:
    """Converts an attitude q (4, xyzw) of OptiTrack's, y up, to q_WB (4, wxyz)."""
    return np.append(q[3], from_optitrack(q[:3]))


def thrust_to_px4(thrust: float, hover_thrust: float, gravity: float) -> float:
    """
    Converts thrust over mass [m/s^2] to PX4's thrust from 0 to 1.

    Args:
        hover_thrust: that carries the weight, PX4's MPC_THR_HOVER.
        gravity: [m/s^2].
    """
    return min(max(hover_thrust * thrust / gravity, 0.0), 1.0)
