"""At which velocity a failsafe flies."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.messaging.failsafe_checks import Box
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.failsafe_modes import Memory
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity_tracking import RESPONSE_TIME
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.flight_limits import (
    LEVEL,
    RETURN_SPEED,
    FlightLimits,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
    stopping_displacement,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS


class Surroundings(NamedTuple):
    """What a vehicle must keep away from."""

    clearance: float
    """[m] from its collision sphere to the nearest known obstacle; NaN if none is known."""
    gradient: np.ndarray
    """(3,) The direction away from that, of any length; 0 if none is known."""
    box: Box
    """In which the collision sphere stays."""
    field: Distances | None
    """What is known of the world, for what lies ahead."""


class Motion(NamedTuple):
    """Where a vehicle is, and where it comes to rest."""

    p_WB: np.ndarray
    """(3,) [m]"""
    stop: np.ndarray
    """(3,) [m] from there to the point of rest."""
    reaction_time: float
    """[s] Time constant with which the point of rest may approach an obstacle."""

    @classmethod
    def predict(
        cls,
        p_WB: np.ndarray,
        v_WB: np.ndarray,
        age: float,
        unpredicted: float,
        deceleration: float,
        law: FlatnessControllerConfig,
    ) -> "Motion":
        """
        Predicts where a vehicle comes to rest that is flown by an old state.

        A command takes effect after a dead time: the age of the state, the lag of the attitude, and
        the period for which commands are held. See `limit_approach`.

        Args:
            p_WB, v_WB: (3,) [m], [m/s].
            age: [s] since the state was measured, up to which it was predicted.
            unpredicted: [s] by which it is older than that.
            deceleration: [m/s^2].
            law: that flies the velocities.
        """
        stop = stopping_displacement(v_WB, RESPONSE_TIME, deceleration)
        dead_time = max(age, 0.0) + unpredicted + 1.0 / law.tilt_gain + law.period
        return cls(p_WB, stop + unpredicted * v_WB, math.e * dead_time)


def flown_setpoint(
    mode: int,
    desired: np.ndarray | None,
    motion: Motion | None,
    memory: Memory,
    near: Surroundings,
    config: FailsafeConfig,
) -> tuple[np.ndarray, int]:
    """
    Computes what is flown in a mode: velocity [m/s], W frame, and heading [rad] or NaN (4,), and
    the limit, a reason of `lcmt_bridge_status` or NONE, for which it is not what is desired.

    Args:
        desired: (4,) by the policy; None if it is flown by commands alone.
        motion: of the vehicle; None if its state cannot be trusted.
    """
    landing = mode == status.LANDING
    max_speed = config.limits.max_speed
    descent = -min(config.descent, max_speed) if landing else 0.0
    if motion is None:
        return np.array([0.0, 0.0, descent, math.nan]), status.NONE
    if mode == status.FLYING:
        if desired is None:
            return np.full(4, math.nan), status.NONE
        limited, limit = limit_velocity(desired[:3], motion, near, config.limits, landing=False)
        return np.append(limit_speed(limited, max_speed), desired[3]), limit
    back = memory.return_velocity(motion.p_WB)
    if landing:
        back[2] = descent
    limited, _ = limit_velocity(back, motion, near, config.limits, landing)
    return np.append(limit_speed(limited, min(max_speed, RETURN_SPEED)), math.nan), status.NONE


def limit_velocity(
    desired: np.ndarray, motion: Motion, near: Surroundings, limits: FlightLimits, landing: bool
) -> tuple[np.ndarray, int]:
    """
    Limits a velocity (3,) [m/s], and gives the last limit, a reason of `lcmt_bridge_status` or
    NONE, that changed it.

    Args:
        desired: (3,) [m/s], W frame.
        landing: whether it may leave the box downwards, and come down on what is level.
    """
    slow = limit_speed(desired, limits.max_speed)
    away, room = np.zeros(3), math.inf
    if not math.isnan(near.clearance) and near.gradient.any():
        away = near.gradient / np.linalg.norm(near.gradient)
        if not (landing and away[2] > LEVEL):
            room = near.clearance - limits.min_clearance + float(motion.stop.dot(away))
    clear = limit_approach(slow, away, room, motion.reaction_time)
    lower, upper = near.box.lower_W + VEHICLE_RADIUS, near.box.upper_W - VEHICLE_RADIUS
    if landing:
        lower[2] = -math.inf
    rest = motion.p_WB + motion.stop
    inside = limit_to_box(clear, rest, lower, upper, motion.reaction_time)
    flown = inside
    # Last, because what leads along a fence or an obstacle may lead into another.
    if near.field is not None and not landing:
        flown = limit_ahead(
            inside, *motion[:2], near.field, limits.min_clearance, motion.reaction_time
        )
    for before, after, reason in (
        (inside, flown, status.LIMITED_CLEARANCE),
        (clear, inside, status.LIMITED_GEOFENCE),
        (slow, clear, status.LIMITED_CLEARANCE),
        (desired, slow, status.LIMITED_SPEED),
    ):
        if not np.array_equal(before, after):
            return flown, reason
    return flown, status.NONE
