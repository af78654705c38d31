"""What depth policies are told: pooled and encoded depth, and the state seen from their heading.

The heading frame H has its origin in the vehicle, z up and x above the body's x axis. Vectors are
numpy arrays; training repeats the same formulas in torch
(`training/policies/torch_observations.py`).
"""

import numpy as np


def pool_depth(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """The nearest depth (height, width) [m] in each block of an image (H, W) of planar depth [m].

    Obstacles thinner than a coarse pixel stay visible this way.

    Raises:
        ValueError: unless H and W are multiples of height and width.
    """
    H, W = depth.shape
    require_poolable(H, W, height, width)
    return depth.reshape(height, H // height, width, W // width).min(axis=(1, 3))


def require_poolable(H: int, W: int, height: int, width: int) -> None:
    """Raises ValueError unless images of H x W pixels can be pooled to height x width."""
    if H < 1 or W < 1 or H % height or W % width:
        raise ValueError(
            f"the depth image has {W}x{H} pixels, but this policy pools it to {width}x{height}; "
            f"give its camera whole multiples of these, as {4 * width}x{4 * height}"
        )


def inverse_depth(depth: np.ndarray, nearest: float, farthest: float) -> np.ndarray:
    """Planar depth (...,) [m] as 3 / z - 0.6, z within [nearest, farthest]; 0 means too near."""
    return 3.0 / np.clip(depth, nearest, farthest) - 0.6


def heading_frame(R_WB: np.ndarray) -> np.ndarray:
    """R_WH (3, 3) of the body attitude R_WB (3, 3)."""
    x, y = R_WB[0, 0], R_WB[1, 0]
    length = max(np.hypot(x, y), 1e-6)
    cos, sin = x / length, y / length
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def target_velocity(
    p_WB: np.ndarray, p_WG: np.ndarray, speed: float, slowing_time: float = 1.0
) -> np.ndarray:
    """The velocity (3,) [m/s] straight to the goal, at `speed` until `slowing_time` [s] before it.

    (p_WG - p_WB) / max(distance / speed, slowing_time).
    """
    to_goal = p_WG - p_WB
    return to_goal / max(float(np.linalg.norm(to_goal)) / speed, slowing_time)


def heading_observation(
    R_WB: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, p_WG: np.ndarray, speed: float
) -> np.ndarray:
    """(9,) target velocity, velocity [m/s] and the body's z axis, all in the heading frame."""
    R_WH = heading_frame(R_WB)
    rows = np.stack([target_velocity(p_WB, p_WG, speed), v_WB, R_WB[:, 2]])
    return (rows @ R_WH).ravel()


def limit_smoothly(output: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """A network's output (N,) within +-limits (N,), smoothly."""
    return limits * np.tanh(output / limits)
