"""What the student is told: images as its network takes them, and the state in the body frame."""

import numpy as np
from pydrake.math import RigidTransform

NEAREST, FARTHEST = 0.3, 20.0  # [m] range of depth
STATE_SIZE = 9


def encode_color(color: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) uint8 as (3, H, W): 0 to 255 as -1 to 1."""
    return color.transpose(2, 0, 1) * np.float32(1.0 / 127.5) - np.float32(1.0)


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Planar depth (H, W) [m] as a grey image (3, H, W): its logarithm, near 1 and far -1.

    Equal ratios of depths are equal contrasts, wherever they are.
    """
    z = np.log(np.clip(depth, NEAREST, FARTHEST, dtype=np.float32))
    near, far = np.log(NEAREST), np.log(FARTHEST)
    encoded = np.float32((far + near) / (far - near)) - np.float32(2.0 / (far - near)) * z
    return np.broadcast_to(encoded, (3, *depth.shape))


def state_observation(
    X_WB: RigidTransform, v_WB: np.ndarray, p_WG: np.ndarray, reach: float
) -> np.ndarray:
    """(9,), in the body frame: velocity [m/s], the vector to the goal, of length 1 beyond `reach`
    [m] and in proportion nearer, and the unit vector upwards."""
    R_WB = X_WB.rotation().matrix()
    to_goal = p_WG - X_WB.translation()
    towards = to_goal / max(float(np.linalg.norm(to_goal)), reach)
    return (np.stack([v_WB, towards, [0.0, 0.0, 1.0]]) @ R_WB).ravel()


def mirrored_vectors(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of the body frame in a mirror: left is right."""
    return vectors * np.array([1.0, -1.0, 1.0])
