"""How fast a vehicle may fly where: what nobody who flies it may exceed."""

import math
from dataclasses import dataclass

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

REACTION_TIME = 0.6
"""[s] that passes before a vehicle brakes that was told to: its answer to velocities."""

LEVEL = 0.7
"""[-] z of the normal of surfaces that can be landed on, at least."""


_SLOW = 0.1  # [m/s], below which nothing lies ahead.
_STEP = 0.1  # [m], at least, between places that are looked at.


@dataclass
class FlightLimits:
    """What is kept whatever a policy decides."""

    # [m/s] Greatest speed.
    max_speed: float = 6.0
    # [rad] Greatest angle between body z and vertical.
    max_tilt: float = 1.0
    # [m/s^2] With which the vehicle can brake in time, along each axis at once.
    deceleration: float = 3.0
    # [m] Between the vehicle's hull and what is known of the world.
    min_clearance: float = 0.1
    # [m] Corners of the box in which the hull stays, the lower one first; the world's where left
    # out.
    geofence: list[list[float]] | None = None

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("max_speed", "max_tilt", "deceleration"):
            _check(name, getattr(self, name), 0.0 < getattr(self, name) < math.inf, "positive")
        _check("max_tilt", self.max_tilt, self.max_tilt <= math.pi / 2, "at most pi/2 rad")
        _check("min_clearance", self.min_clearance, 0.0 <= self.min_clearance <= 5.0, "0 to 5 m")
        if self.geofence is not None:
            fence = np.array(self.geofence, dtype=float)
            valid = fence.shape == (2, 3) and bool((fence[0] < fence[1]).all())
            _check("geofence", self.geofence, valid, "two corners of a box, the lower one first")


def limit_speed(velocity: np.ndarray, max_speed: float) -> np.ndarray:
    """The velocity (3,) [m/s], shortened to `max_speed` [m/s]."""
    size = float(np.linalg.norm(velocity))
    return velocity * min(1.0, max_speed / size) if size > 0.0 else velocity


def limit_approach(
    velocity: np.ndarray, away: np.ndarray, room: float, deceleration: float
) -> np.ndarray:
    """
    The velocity (3,) [m/s] with which a vehicle can still stop within the room that it has.

    Of v only the part towards the obstacle is lessened, to the largest with
    v REACTION_TIME + v² / (2 deceleration) <= room; where there is none left it leads away, by
    room / REACTION_TIME.

    Args:
        away: (3,) unit vector that leads away from the obstacle.
        room: [m] left towards it.
        deceleration: [m/s^2].
    """
    reaction = deceleration * REACTION_TIME
    fastest = math.sqrt(reaction**2 + 2.0 * deceleration * max(room, 0.0)) - reaction
    fastest += min(room, 0.0) / REACTION_TIME
    return velocity + away * max(0.0, -float(velocity.dot(away)) - fastest)


def limit_ahead(
    velocity: np.ndarray, p: np.ndarray, field: Distances, limits: FlightLimits
) -> np.ndarray:
    """The velocity (3,) [m/s], shortened so that a vehicle at p (3,) [m] can stop before the first
    place on its way that is too near to what the field knows."""
    speed = float(np.linalg.norm(velocity))
    if speed < _SLOW:
        return velocity
    way = velocity / speed
    reach = speed * REACTION_TIME + speed**2 / (2.0 * limits.deceleration)
    here = float(field.distance(p)) - VEHICLE_RADIUS
    least = min(limits.min_clearance, here)  # Who is too near may leave.
    ahead, clearance = 0.0, here
    # Beyond what is known, where distances are NaN, nothing is known to be in the way.
    while ahead < reach and clearance >= least:
        ahead += max(clearance - least, _STEP)
        clearance = float(field.distance(p + ahead * way)) - VEHICLE_RADIUS
    if ahead < reach and clearance < least:
        return limit_approach(velocity, -way, ahead, limits.deceleration)
    return velocity


def limit_to_box(
    velocity: np.ndarray, p: np.ndarray, lower: np.ndarray, upper: np.ndarray, deceleration: float
) -> np.ndarray:
    """The velocity (3,) [m/s] with which a vehicle at p (3,) stays in a box [m]."""
    for axis in range(3):
        away = np.zeros(3)
        away[axis] = 1.0
        velocity = limit_approach(velocity, away, p[axis] - lower[axis], deceleration)
        velocity = limit_approach(velocity, -away, upper[axis] - p[axis], deceleration)
    return velocity


def _check(name: str, value: object, valid: bool, limit: str) -> None:
    if not valid:
        raise ValueError(f"limits.{name} is {value}; it must be {limit}")
