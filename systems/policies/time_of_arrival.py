"""Time of arrival at a goal around all obstacles, from everywhere in a distance field.

T solves the eikonal equation |grad T| = S(d), T(goal) = 0, by fast marching (J. A. Sethian, "A fast
marching level set method for monotonically advancing fronts", PNAS 1996). The slowness S rises near
obstacles, so that paths keep to open space, and is infinite where the vehicle does not fit. The
only minimum of T is the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from splatpilot import _native
from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.collision.esdf import Esdf, interpolate_grid
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

OPEN_CLEARANCE = 0.6  # [m] minimum clearance for full speed
CONTACT_SPEED = 0.1  # [-] fraction of full speed at zero clearance
BARRIER_WEIGHT = 1.5  # [-] slowness per meter of the soft barrier, equation (3)


def slowness(distance: np.ndarray) -> np.ndarray:
    """Computes the slowness S(d) [s/m] at `distance` (...,) [m] from obstacles.

        S = 1 / F + 1.5 soft(d),  F from 0.1 at contact to 1 at 0.6 m clearance

    About 1 in open space, where T is the length of the path, and 11 at contact.
    """
    openness = (distance - VEHICLE_RADIUS) / OPEN_CLEARANCE
    speed = CONTACT_SPEED + (1.0 - CONTACT_SPEED) * np.minimum(np.maximum(openness, 0.0), 1.0)
    return 1.0 / speed + BARRIER_WEIGHT * soft_barrier(distance, VEHICLE_RADIUS)


@dataclass(frozen=True, eq=False)
class TimeOfArrival:
    """Time of arrival at a goal over a voxel grid, interpolated trilinearly.

    The unit is seconds at 1 m/s in open space. Voxels without a path to the goal have the value of
    the nearest one with a path, plus the distance to it at the contact speed. Values are constant
    outside the box. Immutable, shared by reference.
    """

    p_WG: np.ndarray  # (3,) [m], the goal
    times: np.ndarray  # (nx, ny, nz) float32 [s] at the centers lower_W + (i + 0.5) voxel_size
    reachable: np.ndarray  # (nx, ny, nz) bool, the voxels with a path to the goal
    lower_W: np.ndarray  # (3,) [m], lower corner of the box
    voxel_size: float  # [m], edge length

    def __deepcopy__(self, memo: dict) -> TimeOfArrival:
        return self  # Copies of a Drake Context share it.

    def value(self, p_WQ: np.ndarray) -> np.ndarray:
        """Interpolates the time of arrival (...,) [s] at p_WQ (..., 3) [m]."""
        return self._interpolate(p_WQ)[0]

    def gradient(self, p_WQ: np.ndarray) -> np.ndarray:
        """Computes the gradient (..., 3) [s/m] of `value` at p_WQ (..., 3) [m]."""
        return self._interpolate(p_WQ)[1]

    def is_reachable(self, p_WQ: np.ndarray, within: float = 0.0) -> bool:
        """Checks that a path leads to the goal from the voxel of p_WQ (3,) [m], or from one that
        the cube of half edge `within` [m] around it touches."""
        from_corner = p_WQ - self.lower_W
        first = np.floor((from_corner - within) / self.voxel_size)
        last = np.floor((from_corner + within) / self.voxel_size)
        if np.any(last < 0) or np.any(first >= self.reachable.shape):
            return False
        first, last = np.maximum(first, 0).astype(int), last.astype(int)
        cube = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
        return bool(self.reachable[cube].any())

    def starts(self, field: Esdf, clearance: float, min_time: Any = -1.0) -> np.ndarray:
        """Lists the voxel centers (n, 3) [m] with a clearance [m] in the field of this grid, from
        which a path of more than `min_time` [s] leads to the goal."""
        free = self.reachable & (field.distances > VEHICLE_RADIUS + clearance)
        cells = np.argwhere(free & (self.times > min_time))
        if len(cells) == 0:
            raise InfeasibleFlightError(
                "no free position with a path to the goal is far enough from it"
            )
        return field.lower_W + field.voxel_size * (cells + 0.5)

    def path(self, p_WQ: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns points (n, 3) [m] of the path from p_WQ (3,) [m] after lengths (n,) [m], and the
        directions (n, 3) of their last quarters; beyond the goal, the goal and zero."""
        step = max(self.voxel_size, 0.1)  # [m] Shorter steps do not resolve more.
        longest = float(np.max(lengths))
        rows = np.empty((ceil(longest / step) + 3, 4))  # both ends, and one for rounding
        grid = {name: getattr(self, name) for name in ("times", "lower_W", "voxel_size", "p_WG")}
        p_WQ = np.ascontiguousarray(p_WQ, dtype=float)
        count = _native.descend(**grid, p_WQ=p_WQ, step=step, length=longest, path=rows)
        *path, covered = rows[:count].T  # 3 of (m,), (m,)

        def point_at(length: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(length, covered, along) for along in path], -1)

        ends = point_at(lengths)
        chords = ends - point_at(0.75 * lengths)
        chords[lengths > covered[-1]] = 0.0
        sizes = np.sqrt([chord.dot(chord) for chord in chords])[:, None]
        return ends, np.divide(chords, sizes, out=np.zeros_like(chords), where=sizes > 0.0)

    def _interpolate(self, p_WQ: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns values and gradients at the points, brought between the voxel centers."""
        first = self.lower_W + 0.5 * self.voxel_size
        last = first + self.voxel_size * (np.array(self.times.shape) - 1.0)
        p_WQ = np.minimum(np.maximum(p_WQ, first), last)
        return interpolate_grid(self.times, self.lower_W, self.voxel_size, p_WQ)


def path_lengths(field: Esdf, p_WG: np.ndarray) -> TimeOfArrival:
    """Computes the lengths [m] of the shortest paths to p_WG (3,) [m] that the vehicle fits
    through, the times of arrival at slowness 1."""
    return time_of_arrival(field, p_WG, slowness=np.ones_like)


def time_of_arrival(
    field: Esdf,
    p_WG: np.ndarray,
    margin: float = 0.0,
    slowness: Callable[[np.ndarray], np.ndarray] = slowness,
) -> TimeOfArrival:
    """Computes the time of arrival at p_WG (3,) [m] from everywhere in a conservative distance
    field, by paths of a minimum clearance `margin` [m] beyond the vehicle's radius."""
    what, remedy = "the distance field", "pass esdf.conservative()"
    require(field.occupied_outside, what, "conservative", "unknown space as free", remedy)
    p_WG = np.array(p_WG, dtype=float)
    valid = p_WG.shape == (3,) and bool(np.isfinite(p_WG).all())
    require(valid, "the goal", "3 finite coordinates [m]", p_WG)
    goal = f"the goal p_WG = {_text(p_WG)} m"
    box = f"from {_text(field.lower_W)} to {_text(field.upper_W)} m"
    if np.any(p_WG < field.lower_W) or np.any(p_WG > field.upper_W):
        raise InfeasibleFlightError(f"{goal} must be inside the known volume {box}")
    goal_distance = field.distance(p_WG)
    clearance = float(goal_distance) - VEHICLE_RADIUS
    if clearance < margin:
        raise InfeasibleFlightError(
            f"the clearance of {goal} beyond the vehicle's radius must be at least {margin:.2f} m, "
            f"got {clearance:.2f} m: an obstacle, unknown space or the boundary of the known "
            f"volume {box} is too close; choose a goal {margin - clearance:.2f} m further into "
            "free space"
        )
    # Starts from a sphere of known times that contains a voxel center; a point start would have
    # the largest error of the grid.
    start = field.voxel_size
    goal_slowness = float(slowness(goal_distance))
    x, y, z = (c - g for c, g in zip(field.voxel_centers(), p_WG, strict=True))
    to_goal = np.sqrt((x**2)[:, None, None] + (y**2)[:, None] + z**2)  # (nx, ny, nz) [m]
    # Not beyond the free space around the goal: there may be another room.
    sphere = to_goal <= min(start, max(float(goal_distance), to_goal.min()))
    speed = np.where(sphere, 1.0 / goal_slowness, 1.0 / slowness(field.distances))
    blocked = (field.distances < VEHICLE_RADIUS + margin) & ~sphere
    marched = np.empty(speed.shape)
    _native.travel_times(
        front=to_goal - start,
        speed=speed,
        blocked=blocked,
        voxel_size=field.voxel_size,
        times=marched,
    )
    reachable = np.isfinite(marched) | sphere
    times = np.where(sphere, to_goal, start) * goal_slowness
    times += np.where(sphere | ~reachable, 0.0, marched)
    if not reachable.all():
        nearest = distance_transform_edt(~reachable, return_distances=False, return_indices=True)
        assert isinstance(nearest, np.ndarray)  # (3, nx, ny, nz) int32, for type checkers
        cells = np.nonzero(~reachable)
        nearest = nearest[:, *cells]
        gap = np.sqrt(np.square(nearest - cells).sum(axis=0))
        times[cells] = times[*nearest] + gap * (field.voxel_size / CONTACT_SPEED)
    times = times.astype(np.float32)
    times.flags.writeable = reachable.flags.writeable = p_WG.flags.writeable = False
    return TimeOfArrival(p_WG, times, reachable, field.lower_W, field.voxel_size)


def _text(p_W: np.ndarray) -> str:
    return "[" + ", ".join(f"{coordinate:.2f}" for coordinate in p_W) + "]"
