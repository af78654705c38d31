"""At which velocity a failsafe flies."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.messaging.failsafe_checks import Box
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.failsafe_modes import Memory
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flight_limits import (
    LEVEL,
    FlightLimits,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS


class Surroundings(NamedTuple):
    """What a vehicle must keep away from."""

    clearance: float
    """[m] from its hull to the nearest obstacle that is known; NaN where none is."""
    gradient: np.ndarray
    """(3,) The direction away from that, of any length; 0 where none is known."""
    box: Box
    """In which the hull stays."""
    field: Distances | None
    """What is known of the world, for what lies ahead."""


def flown_setpoint(
    mode: int,
    wanted: np.ndarray | None,
    p_WB: np.ndarray | None,
    memory: Memory,
    near: Surroundings,
    config: FailsafeConfig,
) -> tuple[np.ndarray, int]:
    """
    What is flown in a mode: velocity [m/s], W frame, and heading [rad] or NaN (4,), and the limit,
    a reason of `lcmt_bridge_status` or NONE, for which it is not what is wanted.

    Args:
        wanted: (4,) by the policy; None where it is flown by commands alone.
        p_WB: (3,) [m], of the vehicle; None where that cannot be trusted.
    """
    landing = mode == status.LANDING
    descent = -config.descent if landing else 0.0
    if p_WB is None:
        return np.array([0.0, 0.0, descent, math.nan]), status.NONE
    if mode == status.FLYING:
        if wanted is None:
            return np.full(4, math.nan), status.NONE
        limited, limit = limit_velocity(wanted[:3], p_WB, near, config.limits, landing=False)
        return np.append(limited, wanted[3]), limit
    back = memory.return_velocity(p_WB)
    if landing:
        back[2] = descent
    limited, _ = limit_velocity(back, p_WB, near, config.limits, landing)
    return np.append(limited, math.nan), status.NONE


def limit_velocity(
    wanted: np.ndarray, p_WB: np.ndarray, near: Surroundings, limits: FlightLimits, landing: bool
) -> tuple[np.ndarray, int]:
    """
    The velocity (3,) [m/s] within the limits, and the last one, a reason of `lcmt_bridge_status` or
    NONE, that changed it.

    Args:
        wanted: (3,) [m/s], W frame.
        p_WB: (3,) [m], of the vehicle.
        landing: whether it may leave the box downwards, and come down on what is level.
    """
    slow = limit_speed(wanted, limits.max_speed)
    away, room = np.zeros(3), math.inf
    if not math.isnan(near.clearance) and near.gradient.any():
        away = near.gradient / np.linalg.norm(near.gradient)
        if not (landing and away[2] > LEVEL):
            room = near.clearance - limits.min_clearance
    clear = limit_approach(slow, away, room, limits.deceleration)
    lower, upper = near.box.lower_W + VEHICLE_RADIUS, near.box.upper_W - VEHICLE_RADIUS
    if landing:
        lower[2] = -math.inf
    inside = limit_to_box(clear, p_WB, lower, upper, limits.deceleration)
    flown = inside
    # Last, because what leads along a fence or an obstacle may lead into another.
    if near.field is not None and not landing:
        flown = limit_ahead(inside, p_WB, near.field, limits)
    for before, after, reason in (
        (inside, flown, status.LIMITED_CLEARANCE),
        (clear, inside, status.LIMITED_GEOFENCE),
        (slow, clear, status.LIMITED_CLEARANCE),
        (wanted, slow, status.LIMITED_SPEED),
    ):
        if not np.array_equal(before, after):
            return flown, reason
    return flown, status.NONE
