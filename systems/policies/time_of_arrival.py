"""Time of arrival: how long the way around all obstacles to a goal is, from everywhere.

The solution T of the eikonal equation |grad T| = S(d), T(goal) = 0, by fast marching over the
grid of a conservative distance field (J. A. Sethian, "A fast marching level set method for
monotonically advancing fronts", PNAS 1996). The slowness S rises with the nearness of obstacles, so
that the way keeps to open space, and is infinite where the vehicle does not fit. Going down T never
ends in a trap: its only minimum is the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy.ndimage import distance_transform_edt

from splatpilot import _native
from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.collision.esdf import Esdf, interpolate_grid
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

OPEN_CLEARANCE = 0.6
"""Clearance [m] from which on the vehicle may fly at full speed."""

CONTACT_SPEED = 0.1
"""Fraction of the full speed [-] at no clearance; linear in between."""

BARRIER_WEIGHT = 1.5
"""Slowness [-] per metre of the soft barrier, equation (3), which reaches further."""


def slowness(distance: np.ndarray) -> np.ndarray:
    """The time S(d) [s] that a metre of way at `distance` (...,) [m] from obstacles counts.

        S = 1 / F + 1.5 soft(d),  F from 0.1 at contact to 1 at 0.6 m clearance

    Close to 1 in the open, where T is the length of the way, and about 11 at contact.
    """
    openness = (distance - VEHICLE_RADIUS) / OPEN_CLEARANCE
    speed = CONTACT_SPEED + (1.0 - CONTACT_SPEED) * np.minimum(np.maximum(openness, 0.0), 1.0)
    return 1.0 / speed + BARRIER_WEIGHT * soft_barrier(distance, VEHICLE_RADIUS)


@dataclass(frozen=True, eq=False)
class TimeOfArrival:
    """Time of arrival at a goal over a voxel grid, interpolated trilinearly.

    The unit is seconds at 1 m/s in open space. Where the vehicle does not fit, and from where no
    way leads to the goal, the value is that of the nearest place with a way plus the distance to it
    at the contact speed: finite, and leading out. Outside the box it is that of the nearest point
    of the grid. Immutable, shared by reference.
    """

    p_WG: np.ndarray
    """(3,) [m] the goal."""
    times: np.ndarray
    """(nx, ny, nz) float32 [s] at the voxel centres lower_W + (i + 0.5) voxel_size."""
    reachable: np.ndarray
    """(nx, ny, nz) bool, the voxels from which a way leads to the goal."""
    lower_W: np.ndarray
    """(3,) [m] lower corner of the box."""
    voxel_size: float
    """[m] edge length of a voxel."""

    def __deepcopy__(self, memo: dict) -> TimeOfArrival:
        return self  # Copies of a Drake Context share it.

    def value(self, p_WQ: np.ndarray) -> np.ndarray:
        """Time of arrival (...,) [s] from p_WQ (..., 3) [m]."""
        return self._interpolate(p_WQ)[0]

    def gradient(self, p_WQ: np.ndarray) -> np.ndarray:
        """Its gradient (..., 3) [s/m] at p_WQ (..., 3) [m]; downhill is the way to the goal."""
        return self._interpolate(p_WQ)[1]

    def is_reachable(self, p_WQ: np.ndarray, within: float = 0.0) -> bool:
        """Checks that a route leads to the goal from the voxel of p_WQ (3,) [m], or from one that
        the cube of half edge `within` [m] about it touches."""
        from_corner = np.asarray(p_WQ) - self.lower_W
        first = np.floor((from_corner - within) / self.voxel_size)
        last = np.floor((from_corner + within) / self.voxel_size)
        if np.any(last < 0) or np.any(first >= self.reachable.shape):
            return False
        first, last = np.maximum(first, 0).astype(int), last.astype(int)
        cube = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
        return bool(self.reachable[cube].any())

    def way(self, p_WQ: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) [m] and directions (n, 3) of the way to the goal from p_WQ (3,) [m].

        Each after its length (n,) [m] of way, with the direction of the last quarter of that; or at
        the goal if that is nearer, with direction zero.
        """
        step = max(self.voxel_size, 0.1)  # [m] Shorter steps resolve nothing more.
        longest = float(np.max(lengths))
        rows = np.empty((ceil(longest / step) + 3, 4))  # both ends, and one for rounding
        count = _native.descend(
            times=self.times,
            lower_W=self.lower_W,
            voxel_size=self.voxel_size,
            p_WG=self.p_WG,
            p_WQ=np.ascontiguousarray(p_WQ, dtype=float),
            step=step,
            length=longest,
            way=rows,
        )
        *way, covered = rows[:count].T  # 3 of (m,), (m,)

        def point_at(length: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(length, covered, along) for along in way], -1)

        ends = point_at(lengths)
        chords = ends - point_at(0.75 * lengths)
        chords[lengths > covered[-1]] = 0.0
        return ends, np.array([_unit(chord) for chord in chords])

    def _interpolate(self, p_WQ: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns values and gradients at the points, brought between the voxel centers."""
        first = self.lower_W + 0.5 * self.voxel_size
        last = first + self.voxel_size * (np.array(self.times.shape) - 1.0)
        p_WQ = np.minimum(np.maximum(p_WQ, first), last)
        return interpolate_grid(self.times, self.lower_W, self.voxel_size, p_WQ)


def way_lengths(field: Esdf, p_WG: np.ndarray) -> TimeOfArrival:
    """The lengths [m] of the shortest ways to the goal p_WG (3,) [m] that the vehicle fits through:
    the times of arrival at 1 m/s, however near the obstacles.

    Raises:
        ValueError, InfeasibleFlightError: see `time_of_arrival`.
    """
    return time_of_arrival(field, p_WG, slowness=np.ones_like)


def time_of_arrival(
    field: Esdf,
    p_WG: np.ndarray,
    margin: float = 0.0,
    slowness: Callable[[np.ndarray], np.ndarray] = slowness,
) -> TimeOfArrival:
    """The time of arrival at the goal p_WG (3,) [m] from everywhere in a distance field.

    Args:
        field: a conservative distance field, `Esdf.conservative()`.
        p_WG: the goal [m].
        margin: the least clearance of the way [m], beyond the vehicle's radius.
        slowness: S(d) [s/m].

    Raises:
        ValueError: if the field is not conservative, or the goal not finite.
        InfeasibleFlightError: if the goal is outside the field's box, or at less clearance than
            `margin`.
    """
    if not field.occupied_outside:
        raise ValueError(
            "The distance field counts unknown space as free and ends at its bounds, but ways are "
            "planned through known free space only; pass esdf.conservative()."
        )
    p_WG = np.array(p_WG, dtype=float)
    if p_WG.shape != (3,) or not np.isfinite(p_WG).all():
        raise ValueError(f"The goal is {p_WG} but must be 3 finite coordinates [m] in the world.")
    where = f"The goal p_WG = {_text(p_WG)} m"
    box = f"from {_text(field.lower_W)} to {_text(field.upper_W)} m"
    if np.any(p_WG < field.lower_W) or np.any(p_WG > field.upper_W):
        raise InfeasibleFlightError(
            f"{where} lies outside the known volume {box}; choose a goal inside it."
        )
    goal_distance = field.distance(p_WG)
    clearance = float(goal_distance) - VEHICLE_RADIUS
    if clearance < margin:
        raise InfeasibleFlightError(
            f"{where} has a clearance of {clearance:.2f} m beyond the vehicle's radius of "
            f"{VEHICLE_RADIUS} m, but needs at least {margin:.2f} m: it is inside or too close to "
            f"an obstacle, unknown space or the boundary of the known volume {box}; choose a goal "
            f"{margin - clearance:.2f} m further into free space."
        )
    # The march starts from a ball around the goal where the times are known, large enough to hold a
    # voxel centre: from a point it would start with the grid's largest error.
    start = field.voxel_size
    goal_slowness = float(slowness(goal_distance))
    x, y, z = (c - g for c, g in zip(field.voxel_centers(), p_WG, strict=True))
    to_goal = np.sqrt((x**2)[:, None, None] + (y**2)[:, None] + z**2)  # (nx, ny, nz) [m]
    ball = to_goal <= start
    speed = np.where(ball, 1.0 / goal_slowness, 1.0 / slowness(field.distances))
    blocked = (field.distances < VEHICLE_RADIUS + margin) & ~ball
    front = np.ma.MaskedArray(to_goal - start, mask=blocked)
    import skfmm  # Has no wheels for ARM, where all but planning works without it.

    marched = skfmm.travel_time(front, speed, dx=field.voxel_size, order=2)
    reachable = ~np.ma.getmaskarray(marched)
    times = np.where(ball, to_goal, start) * goal_slowness
    times += np.where(ball, 0.0, np.ma.getdata(marched))
    if not reachable.all():
        gap, nearest = distance_transform_edt(~reachable, return_indices=True)  # type: ignore
        times = times[tuple(nearest)] + gap * (field.voxel_size / CONTACT_SPEED)
    times = times.astype(np.float32)
    times.flags.writeable = reachable.flags.writeable = p_WG.flags.writeable = False
    return TimeOfArrival(p_WG, times, reachable, field.lower_W, field.voxel_size)


def _unit(vector: np.ndarray) -> np.ndarray:
    """`vector` (3,) at unit length; zero stays zero."""
    length = np.sqrt(vector.dot(vector))
    return vector / length if length > 0.0 else vector


def _text(p_W: np.ndarray) -> str:
    return "[" + ", ".join(f"{coordinate:.2f}" for coordinate in p_W) + "]"
