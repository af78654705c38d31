"""Conversion between our frames and those of PX4 and OptiTrack; no other module converts them.

Ours are the world W, z up, and the body B: x forward, y left, z up. PX4's are its local frame, x
north, y east, z down, and the body x forward, y right, z down. W is the local frame rotated by half
a turn about its x axis: x north, y west. OptiTrack's world and bodies, y up: x north, y up, z east.
"""

import numpy as np


def swap_px4(v: np.ndarray) -> np.ndarray:
    """Converts a vector (3,) between W or B and PX4's local or body frame, or an attitude (4, wxyz)
    between W and the local frame, in either direction."""
    return np.append(v[:-2], -v[-2:])


def pose_from_optitrack(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Converts a position p (3,) and an attitude q (4, xyzw) of OptiTrack to (p_WB, q_WB) (7,)."""
    (x, y, z), (qx, qy, qz, qw) = p, q
    return np.array([x, -z, y, qw, qx, -qz, qy])


def thrust_to_px4(thrust: float, hover_thrust: float, gravity: float) -> float:
    """Converts thrust over mass [m/s^2] to PX4's thrust from 0 to 1, which at `hover_thrust`,
    PX4's MPC_THR_HOVER, carries the weight."""
    return min(max(hover_thrust * thrust / gravity, 0.0), 1.0)
