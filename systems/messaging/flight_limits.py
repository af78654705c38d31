"""Limits on commanded velocities: speed, clearance, geofence and braking distance."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity import RESPONSE_TIME
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

LEVEL = 0.7  # [-] Min z of the normal of surfaces that can be landed on.
RETURN_SPEED = 1.0  # [m/s] Max speed back into the allowed volume.
_STEP = 0.05  # [m] between checked points of a path.
_MAX_STEPS = 1000  # Only invalid states need more.


@dataclass
class FlightLimits(Config):
    """Limits that hold for every policy."""

    # [m/s] Max speed.
    max_speed: float = bounded(6.0, "(0, inf) m/s")
    # [rad] Max angle between body z and vertical.
    max_tilt: float = bounded(1.0, "(0, 1.5707963267948966] rad")
    # [m/s^2] Assumed braking deceleration; the controller commands up to 6.
    deceleration: float = bounded(5.0, "(0, inf) m/s^2")
    # [m] Min distance from the collision sphere to known obstacles.
    min_clearance: float = bounded(0.1, "[0, 5] m")
    # [m] Corners of the box that holds the collision sphere, the lower one first; the world's
    # box if left out.
    geofence: list[list[float]] | None = None

    def check(self) -> None:
        if self.geofence is None:
            return
        fence = np.array(self.geofence, dtype=float)
        min_side = 2.0 * (VEHICLE_RADIUS + self.min_clearance)
        valid = fence.shape == (2, 3) and bool((fence[1] - fence[0] >= min_side).all())
        condition = f"two corners of a box, the lower one first, at least {min_side:.2f} m apart"
        require_field(self, "geofence", valid, condition)


class Box(NamedTuple):
    """An axis-aligned box."""

    lower_W: np.ndarray  # (3,) [m]
    upper_W: np.ndarray  # (3,) [m]


class Surroundings(NamedTuple):
    """Obstacles and bounds near a vehicle."""

    clearance: float  # [m] from the collision sphere to the nearest obstacle; NaN if unknown.
    gradient: np.ndarray  # (3,) direction away from that obstacle, any length; 0 if unknown.
    box: Box  # that must hold the collision sphere.
    field: Distances | None  # distances to known obstacles.


class Motion(NamedTuple):
    """Position and predicted point of rest of a vehicle."""

    p_WB: np.ndarray  # (3,) [m]
    stop: np.ndarray  # (3,) [m] from there to the point of rest.
    reaction_time: float  # [s] time constant with which the point of rest may near an obstacle.

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
        """Predicts where a vehicle that is controlled by a delayed state comes to rest. A command
        takes effect after a dead time: the `age` of the state [s], for which it is predicted,
        `unpredicted` age [s], the lag of the attitude, and the period of commands."""
        stop = stopping_displacement(v_WB, RESPONSE_TIME, deceleration)
        dead_time = max(age, 0.0) + unpredicted + 1.0 / law.tilt_gain + law.period
        return cls(p_WB, stop + unpredicted * v_WB, math.e * dead_time)


def limit_velocity(
    desired: np.ndarray, motion: Motion, near: Surroundings, limits: FlightLimits, landing: bool
) -> tuple[np.ndarray, int]:
    """Limits a velocity (3,) [m/s]. Also returns the last limit that changed it, a reason of
    `lcmt_bridge_status`, or NONE. `landing` allows leaving the box downwards, and touching level
    surfaces."""
    velocity, reason = desired, status.NONE

    def apply(limited: np.ndarray, limit: int) -> None:
        nonlocal velocity, reason
        if not np.array_equal(limited, velocity):
            velocity, reason = limited, limit

    apply(limit_speed(velocity, limits.max_speed), status.LIMITED_SPEED)

    # The nearest obstacle.
    if not math.isnan(near.clearance) and near.gradient.any():
        away = near.gradient / np.linalg.norm(near.gradient)
        if not (landing and away[2] > LEVEL):
            room = near.clearance - limits.min_clearance + float(motion.stop.dot(away))
            limited = limit_approach(velocity, away, room, motion.reaction_time)
            apply(limited, status.LIMITED_CLEARANCE)

    # The box.
    lower, upper = near.box.lower_W + VEHICLE_RADIUS, near.box.upper_W - VEHICLE_RADIUS
    if landing:
        lower[2] = -math.inf
    limited, rest = velocity, motion.p_WB + motion.stop
    for axis, away in enumerate(np.eye(3)):
        limited = limit_approach(limited, away, rest[axis] - lower[axis], motion.reaction_time)
        limited = limit_approach(limited, -away, upper[axis] - rest[axis], motion.reaction_time)
    apply(limited, status.LIMITED_GEOFENCE)

    # The path, last: velocities along a fence or an obstacle may lead into another.
    if near.field is not None and not landing:
        limited = limit_ahead(velocity, motion, near.field, limits.min_clearance)
        apply(limited, status.LIMITED_CLEARANCE)
    return velocity, reason


def limit_speed(velocity: np.ndarray, max_speed: float) -> np.ndarray:
    """Shortens a velocity (3,) [m/s] to `max_speed` [m/s]."""
    size = float(np.linalg.norm(velocity))
    return velocity * min(1.0, max_speed / size) if size > 0.0 else velocity


def stopping_displacement(
    velocity: np.ndarray, response_time: float, deceleration: float
) -> np.ndarray:
    """Predicts the displacement (3,) [m] of a vehicle from a command to stop until rest.

    Its velocity v follows a commanded velocity u as v' = (u - v) / T, with T the response time, but
    brakes with at most a: over the distance T v, or (v² + (a T)²) / (2 a) from v = a T. The point
    of rest p + T v then moves with the commanded velocity: (p + T v)' = v + (u - v) = u.
    """
    speed, exponential = float(np.linalg.norm(velocity)), deceleration * response_time
    if speed <= exponential:
        return response_time * velocity
    return velocity * ((speed + exponential**2 / speed) / (2.0 * deceleration))


def limit_approach(
    velocity: np.ndarray, away: np.ndarray, room: float, reaction_time: float
) -> np.ndarray:
    """Limits a commanded velocity (3,) [m/s] so that the point of rest stays off an obstacle, which
    is `room` [m] away against the unit vector `away` (3,).

    Only the part toward the obstacle is reduced, to at most room / reaction_time; if the room is
    negative it leads away, by at most `RETURN_SPEED`. A point that obeys after a dead time t
    approaches without overshoot if reaction_time >= e t.
    """
    fastest = max(room / reaction_time, -RETURN_SPEED)
    return velocity + away * max(0.0, -float(velocity.dot(away)) - fastest)


def limit_ahead(
    velocity: np.ndarray, motion: Motion, field: Distances, min_clearance: float
) -> np.ndarray:
    """Limits a commanded velocity (3,) [m/s] by obstacles on the path: straight to the point of
    rest, and from there along the velocity. Outside of the field, where distances are NaN, the path
    is free. A vehicle that is nearer than `min_clearance` [m] may leave."""
    p, stop, reaction_time = motion
    nearest = min(min_clearance, float(field.distance(p)) - VEHICLE_RADIUS)
    for start, path in ((p, stop), (p + stop, velocity * reaction_time)):
        length = float(np.linalg.norm(path))
        if length < 1e-6:
            continue
        steps = math.ceil(min(length / _STEP, _MAX_STEPS))
        along = np.linspace(0.0, length, steps + 1)  # (N,) [m]
        points = start + path * (along / length)[:, None]
        blocked = field.distance(points) - VEHICLE_RADIUS < nearest - 1e-9
        if blocked.any():
            free = along[max(int(np.argmax(blocked)) - 1, 0)]
            room = free - length if path is stop else free
            return limit_approach(velocity, -path / length, room, reaction_time)
    return velocity
