"""What DepthNav's policy sees, what network it has and what its output means.

The start frame S has its origin anywhere, z up, and x above the body's x axis at the first update.
"""

from math import atan2, cos, sin
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.observation import (
    limit_smoothly,
    pool_depth,
    target_velocity,
)
from splatpilot.systems.policies.recurrent_network import NetworkSpec, RecurrentNetwork

RATE = 25.0  # [Hz]
IMAGE_SIZE = 128, 72  # [px] width and height before pooling
FOV_X = 87.0  # [deg]
NEAREST, FARTHEST = 0.25, 20.0  # [m] range of depth
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the start frame

DEPTHNAV_NETWORK = NetworkSpec(
    image_height=12,
    image_width=16,
    convolutions=((32, 3, 2, 1), (64, 3, 2, 1), (128, 3, 1, 0)),
    state_size=11,
    state_features=64,
    hidden_size=192,
    output_size=4,
)


class Decision(NamedTuple):
    """What the vehicle should do."""

    a_WB: np.ndarray  # (3,) [m/s^2] in W, gravity excluded
    heading: float  # [rad]
    memory: np.ndarray  # (H,)


def heading_yaw(R_WB: np.ndarray) -> float:
    """The angle [rad] from world x to the body's x axis, seen from above."""
    return atan2(R_WB[1, 0], R_WB[0, 0])


def yaw_rotation(yaw: float) -> np.ndarray:
    """The rotation (3, 3) about z by `yaw` [rad]."""
    return np.array([[cos(yaw), -sin(yaw), 0.0], [sin(yaw), cos(yaw), 0.0], [0.0, 0.0, 1.0]])


def decide(
    network: RecurrentNetwork,
    depth: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    start_yaw: float,
    memory: np.ndarray,
) -> Decision:
    """The policy's answer to one observation.

    Args:
        network: of the architecture `DEPTHNAV_NETWORK`.
        depth: (H, W) [m] planar, whole multiples of 12 and 16 pixels.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        start_yaw: of the start frame [rad].
        memory: (H,), before.

    Raises:
        ValueError: for a depth image of another size.
    """
    spec, R_WS = network.spec, yaw_rotation(start_yaw)
    nearest = pool_depth(depth, spec.image_height, spec.image_width)
    image = 1.0 / np.clip(nearest, NEAREST, FARTHEST)
    q_SB = _about_z(-start_yaw, X_WB.rotation().ToQuaternion().wxyz())
    v_target = target_velocity(X_WB.translation(), p_WG, speed)
    state = np.concatenate([v_WB @ R_WS, q_SB, v_target @ R_WS, [speed]])
    output, memory = network.step(image, state, memory)
    a_WB = R_WS @ limit_smoothly(output[:3], ACCELERATION_LIMITS)
    to_goal = atan2(v_target[1], v_target[0])
    heading = to_goal + np.pi * np.tanh(float(output[3]) / np.pi)
    return Decision(a_WB, heading, memory)


def _about_z(yaw: float, q: np.ndarray) -> np.ndarray:
    """The quaternion (4,) wxyz of q turned about z by `yaw` [rad], with w >= 0."""
    c, s = cos(yaw / 2), sin(yaw / 2)
    w, x, y, z = q
    turned = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    return np.copysign(1.0, turned[0]) * turned
