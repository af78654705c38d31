"""What DiffAero's policy sees, what network it has and what its output means."""

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.observation import (
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
    pool_depth,
)
from splatpilot.systems.policies.recurrent_network import NetworkSpec, RecurrentNetwork

RATE = 15.0  # [Hz]
FOV_X = 90.0  # [deg]
NEAREST, FARTHEST = 0.3, 12.0  # [m] range of depth
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the heading frame

DIFFAERO_NETWORK = NetworkSpec(
    image_height=9,
    image_width=16,
    convolutions=((16, 3, 2, 1), (32, 3, 2, 1), (32, 3, 1, 0)),
    state_size=9,
    state_features=64,
    hidden_size=128,
    output_size=3,
)


def decide(
    network: RecurrentNetwork,
    depth: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration a_WB (3,) [m/s^2] in W, gravity excluded, and the memory (H,) afterwards.

    Args:
        network: of the architecture `DIFFAERO_NETWORK`.
        depth: (H, W) [m] planar, whole multiples of 9 and 16 pixels.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.

    Raises:
        ValueError: for a depth image of another size.
    """
    nearest = pool_depth(depth, network.spec.image_height, network.spec.image_width)
    grid = inverse_depth(nearest, NEAREST, FARTHEST)
    return decide_by_grid(network, grid, X_WB, v_WB, p_WG, speed, memory)


def decide_by_grid(
    network: RecurrentNetwork,
    grid: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """As `decide`, of the inverse depths `grid` (9, 16), see `inverse_depth`, that are nearest in
    each cell."""
    R_WB = X_WB.rotation().matrix()
    state = heading_observation(R_WB, X_WB.translation(), v_WB, p_WG, speed)
    output, memory = network.step(grid, state, memory)
    return heading_frame(R_WB) @ limit_smoothly(output, ACCELERATION_LIMITS), memory
