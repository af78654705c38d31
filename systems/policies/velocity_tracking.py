"""From velocities that are wanted to accelerations that a vehicle can fly."""

import numpy as np

RESPONSE_TIME = 0.4
"""[s], time constant with which a wanted velocity is approached; the attitude's own is 0.1 s."""

MAX_ACCELERATION = 6.0
"""[m/s^2], of what is asked for: a tilt of 31 degrees."""

_SLOWING_TIME = 0.75  # [s], of flight at full speed before the goal in which the speed falls.


def approach_velocity(p_WB: np.ndarray, p_WG: np.ndarray, speed: float) -> np.ndarray:
    """The velocity v_WB (3,) [m/s] straight to the goal at `speed`, falling linearly near it."""
    to_goal = p_WG - p_WB
    distance = float(np.sqrt(to_goal.dot(to_goal)))
    return to_goal * (speed / max(distance, _SLOWING_TIME * speed))


def tracking_acceleration(v_WB: np.ndarray, v_wanted: np.ndarray) -> np.ndarray:
    """The acceleration (3,) [m/s^2] that lets v_WB approach `v_wanted` (3,) [m/s] exponentially.

    a = (v_wanted - v_WB) / 0.4 s, shortened to 6 m/s^2.
    """
    acceleration = (v_wanted - v_WB) / RESPONSE_TIME
    size = float(np.sqrt(acceleration.dot(acceleration)))
    return acceleration * min(1.0, MAX_ACCELERATION / size) if size > 0.0 else acceleration
