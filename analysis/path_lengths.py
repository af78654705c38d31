"""Ways through distance fields: the shortest for the vehicle, and how far a straight one leads."""

import numpy as np
import skfmm
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.feasibility import cell_of, conservative_distance
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

SPACING = 0.2
"""[m], of the grid on which ways are searched."""


def shortest_path(field: DistanceField, grid: NDArray, p_WS: NDArray, p_WG: NDArray) -> NDArray:
    """Points (K, 3) [m] of a shortest way for the vehicle: down the solution of the eikonal
    equation on the grid of distances, then pulled straight where the exact field allows it.

    Raises:
        InfeasibleFlightError: if there is none on the grid.
    """
    shape, goal = grid.shape, cell_of(field, grid, SPACING, p_WG)
    front = np.ones(shape)
    front[goal] = -1.0
    blocked = grid < VEHICLE_RADIUS + 0.02
    blocked[goal] = False
    marched = skfmm.distance(np.ma.MaskedArray(front, mask=blocked), dx=SPACING)
    length = np.where(np.ma.getmaskarray(marched), np.inf, np.ma.getdata(marched))
    cell = cell_of(field, grid, SPACING, p_WS)
    if not np.isfinite(length[cell]):
        raise InfeasibleFlightError("no path from start to goal was found on a grid of 0.2 m")
    offsets = np.array([o for o in np.ndindex(3, 3, 3) if o != (1, 1, 1)]) - 1
    cells = [cell]
    while cells[-1] != goal:
        near = np.array(cells[-1]) + offsets
        near = near[((near >= 0) & (near < shape)).all(axis=1)]
        slope = (length[tuple(near.T)] - length[cells[-1]]) / np.linalg.norm(
            near - cells[-1], axis=1
        )
        best = int(np.argmin(slope))
        if not slope[best] < 0:
            break
        cells.append(tuple(int(c) for c in near[best]))
    centers = field.lower_W + SPACING * (np.array(cells[1:-1]).reshape(-1, 3) + 0.5)
    return _pulled(field, np.concatenate([p_WS[None], centers, p_WG[None]]))


def _pulled(field: DistanceField, points: NDArray) -> NDArray:
    """Leaves out points (K, 3) that straight, free segments make needless."""
    kept, here = [0], 0
    while here < len(points) - 1:
        step = 1
        while here + 2 * step < len(points) and _free(field, points[here], points[here + 2 * step]):
            step *= 2
        low, high = step, min(2 * step, len(points) - 1 - here)
        while low < high:  # the furthest that is seen, if seeing is monotonic between these
            middle = (low + high + 1) // 2
            if _free(field, points[here], points[here + middle]):
                low = middle
            else:
                high = middle - 1
        here += low
        kept.append(here)
    return points[kept]


def _free(field: DistanceField, p_A: NDArray, p_B: NDArray) -> bool:
    points = np.linspace(p_A, p_B, max(int(np.linalg.norm(p_B - p_A) / 0.05), 2))
    return bool((conservative_distance(field, points) > VEHICLE_RADIUS).all())


def march(
    field: DistanceField, p_W: NDArray, way: NDArray, radius: float, longest: float
) -> NDArray:
    """How far (N,) [m] a ball of `radius` flies from p_W (N, 3) along the unit vectors `way` (N, 3)
    until it touches a surface or its centre leaves the bounds, at most `longest`, by sphere
    tracing."""
    flown, going = np.zeros(len(p_W)), np.arange(len(p_W))
    for _ in range(200):
        p = p_W[going] + flown[going, None] * way[going]
        room = np.where(inside(field, p), field.distance(p), -np.inf) - radius
        going, room = going[room > 0.01], room[room > 0.01]
        flown[going] = np.minimum(flown[going] + room, longest)
        going = going[flown[going] < longest]
        if not len(going):
            break
    bounds_W = np.where(way > 0, field.upper_W, field.lower_W)
    ahead = np.where(way == 0, 1.0, way)
    to_bounds = np.where(way == 0, np.inf, (bounds_W - p_W) / ahead).min(axis=1)
    return np.minimum(flown, to_bounds)


def path_length(path: NDArray) -> float:
    """Length [m] of the path (K, 3) [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def resampled(path: NDArray, step: float) -> NDArray:
    """Points (N, 3) on the path (K, 3), about `step` [m] apart, both ends included."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    s = np.linspace(0.0, at[-1], max(int(np.ceil(at[-1] / step)), 1) + 1)
    return np.column_stack([np.interp(s, at, path[:, k]) for k in range(3)])


def inside(field: DistanceField, p_W: NDArray) -> NDArray[np.bool_]:
    """Whether p_W (..., 3) [m] lie in the field's bounds: (...,)."""
    return ((p_W >= field.lower_W) & (p_W <= field.upper_W)).all(axis=-1)
