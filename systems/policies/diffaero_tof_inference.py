"""What DiffAero sees through a time-of-flight sensor, and what its output means then."""

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.diffaero_inference import DIFFAERO_NETWORK, RATE
from splatpilot.systems.policies.observation import (
    heading_frame,
    heading_observation,
    limit_smoothly,
)
from splatpilot.systems.policies.recurrent_network import RecurrentNetwork

__all__ = ["DIFFAERO_NETWORK", "FOV_X", "FOV_Y", "RATE", "VELOCITY_LIMITS", "decide"]

FOV_X, FOV_Y = 86.0, 48.375  # [deg]
VELOCITY_LIMITS = np.array([6.0, 6.0, 3.0])  # [m/s], in the heading frame


def decide(
    network: RecurrentNetwork,
    grid: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The velocity (3,) [m/s] in W that the vehicle should take up, and the memory (H,) afterwards.

    Args:
        network: of the architecture `DIFFAERO_NETWORK`.
        grid: (9, 16) proximities, see `time_of_flight_grid`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.
    """
    R_WB = X_WB.rotation().matrix()
    state = heading_observation(R_WB, X_WB.translation(), v_WB, p_WG, speed)
    output, memory = network.step(grid, state, memory)
    return heading_frame(R_WB) @ limit_smoothly(output, VELOCITY_LIMITS), memory
