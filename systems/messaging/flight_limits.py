"""How fast a vehicle may fly where, whatever a policy decides."""

import math
from dataclasses import dataclass

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

LEVEL = 0.7
"""[-] Min z of the normal of surfaces that can be landed on."""

RETURN_SPEED = 1.0
"""[m/s] Max speed back to where a vehicle may be."""

_STEP = 0.05  # [m] Between points of a path that are checked; more on paths
_MAX_STEPS = 1000  # [-] that would have more, which only states have that cannot be true.


@dataclass
class FlightLimits:
    """What is kept whatever a policy decides."""

    # [m/s] Max speed.
    max_speed: float = 6.0
    # [rad] Max angle between body z and vertical.
    max_tilt: float = 1.0
    # [m/s^2] With which the vehicle is sure to brake; the controller commands up to 6.
    deceleration: float = 5.0
    # [m] Min distance from the collision sphere to what is known of the world.
    min_clearance: float = 0.1
    # [m] Corners of the box in which the collision sphere stays, the lower one first; the world's
    # box if left out.
    geofence: list[list[float]] | None = None

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("max_speed", "max_tilt", "deceleration"):
            _check(name, getattr(self, name), 0.0 < getattr(self, name) < math.inf, "positive")
        _check("max_tilt", self.max_tilt, self.max_tilt <= math.pi / 2, "at most pi/2 rad")
        _check("min_clearance", self.min_clearance, 0.0 <= self.min_clearance <= 5.0, "0 to 5 m")
        if self.geofence is not None:
            fence = np.array(self.geofence, dtype=float)
            min_side = 2.0 * (VEHICLE_RADIUS + self.min_clearance)
            valid = fence.shape == (2, 3) and bool((fence[1] - fence[0] >= min_side).all())
            limit = (
                "two corners of a box, the lower one first, with sides of at least "
                f"{min_side:.2f} m: those of the collision sphere and min_clearance"
            )
            _check("geofence", self.geofence, valid, limit)


def limit_speed(velocity: np.ndarray, max_speed: float) -> np.ndarray:
    """Shortens a velocity (3,) [m/s] to `max_speed` [m/s]."""
    size = float(np.linalg.norm(velocity))
    return velocity * min(1.0, max_speed / size) if size > 0.0 else velocity


def stopping_displacement(
    velocity: np.ndarray, response_time: float, deceleration: float
) -> np.ndarray:
    """
    Predicts by how much (3,) [m] a vehicle moves on after it is told to stop.

    Its velocity v takes up a commanded velocity u as v' = (u - v) / T, with T the response time,
    but brakes with at most a: over the distance T v, or (v² + (a T)²) / (2 a) from v = a T. The
    point p + T v at which it would rest then moves with exactly the commanded velocity, since
    (p + T v)' = v + (u - v) = u.

    Args:
        velocity: (3,) [m/s].
        response_time: T [s].
        deceleration: a [m/s^2].
    """
    speed, exponential = float(np.linalg.norm(velocity)), deceleration * response_time
    if speed <= exponential:
        return response_time * velocity
    return velocity * ((speed + exponential**2 / speed) / (2.0 * deceleration))


def limit_approach(
    velocity: np.ndarray, away: np.ndarray, room: float, reaction_time: float
) -> np.ndarray:
    """
    Limits a commanded velocity (3,) [m/s] so that the point of rest stays off an obstacle.

    Only the part towards the obstacle is reduced, to at most room / reaction_time; if the room is
    negative it leads away, by at most `RETURN_SPEED`. A point that obeys after a dead time t
    approaches without overshoot if reaction_time >= e t.

    Args:
        away: (3,) unit vector that leads away from the obstacle.
        room: [m] from the point of rest to the obstacle, see `stopping_displacement`.
        reaction_time: [s].
    """
    fastest = max(room / reaction_time, -RETURN_SPEED)
    return velocity + away * max(0.0, -float(velocity.dot(away)) - fastest)


def limit_ahead(
    velocity: np.ndarray,
    p: np.ndarray,
    stop: np.ndarray,
    field: Distances,
    min_clearance: float,
    reaction_time: float,
) -> np.ndarray:
    """
    Limits a commanded velocity (3,) [m/s] by what lies on the path: straight to the point of rest,
    and from there on along the velocity.

    Args:
        p: (3,) [m] position of the vehicle.
        stop: (3,) [m] from there to the point of rest.
        field: what is known of the world. Beyond it, where distances are NaN, the path is free.
        min_clearance: [m]. A vehicle that is nearer than that may leave.
        reaction_time: [s].
    """
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


def limit_to_box(
    velocity: np.ndarray,
    rest: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    reaction_time: float,
) -> np.ndarray:
    """Limits a commanded velocity (3,) [m/s] so that the point of rest (3,) [m] stays in a box."""
    for axis, away in enumerate(np.eye(3)):
        velocity = limit_approach(velocity, away, rest[axis] - lower[axis], reaction_time)
        velocity = limit_approach(velocity, -away, upper[axis] - rest[axis], reaction_time)
    return velocity


def _check(name: str, value: object, valid: bool, limit: str) -> None:
    if not valid:
        raise ValueError(f"limits.{name} must be {limit}, got {value}")
