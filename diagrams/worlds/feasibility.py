"""Whether a way from start to goal exists, proven by search on the distance field."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf_from_distance_field import cubes_of_points
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.seeds import check_seed
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

CLEARANCE = 0.8
"""[m], least distance of start and goal from everything, the bounds included."""

TRIES = 60
"""Draws of an instance before its parameters are refused."""


def draw_feasible(draw: Callable[[np.random.Generator], Blueprint], seed: int) -> Blueprint:
    """Draws instances of a world from `seed` until one is feasible: the same seed, the same bits.

    Raises:
        ValueError: for a seed out of range.
        InfeasibleFlightError: if none of `TRIES` instances is feasible.
    """
    check_seed(seed)
    name = "world"
    for attempt in range(TRIES):
        blueprint = draw(np.random.default_rng([seed, attempt]))
        name = blueprint.name
        if is_feasible(blueprint):
            return blueprint
    raise InfeasibleFlightError(
        f"{name}: none of {TRIES} instances drawn from seed {seed} leaves a vehicle of radius "
        f"{VEHICLE_RADIUS} m a way from start to goal; use fewer or smaller obstacles, or more room"
    )


def is_feasible(blueprint: Blueprint) -> bool:
    """Whether start and goal are clear and a way between them is proven: on a coarse grid, which
    shows most ways, or else on finer ones, the last of which shows ways through gaps of 1 m."""
    field = blueprint.distance_field
    ends = np.stack([blueprint.p_WS, blueprint.p_WG])
    if not (conservative_distance(field, ends) >= CLEARANCE).all():
        return False
    return any(
        connects(field, blueprint.p_WS, blueprint.p_WG, VEHICLE_RADIUS, spacing)
        for spacing in (0.3, 0.15, 0.12)
    )


def conservative_distance(field: DistanceField, p_WQ: NDArray) -> NDArray[np.float64]:
    """Distance (...,) [m] of points p_WQ (..., 3) inside the bounds to surfaces and the bounds."""
    to_bounds = np.minimum(p_WQ - field.lower_W, field.upper_W - p_WQ).min(axis=-1)
    return np.minimum(field.distance(p_WQ), to_bounds)


def connects(
    field: DistanceField, p_WS: NDArray, p_WG: NDArray, radius: float, spacing: float
) -> bool:
    """Whether a grid proves that a sphere of `radius` [m] can fly from p_WS to p_WG (3,) [m].

    Neighbours along an axis, `spacing` h [m] apart, both further than radius + h / 2 from every
    obstacle, are joined by a free segment: no point of it is further than h / 2 from one of them,
    and distances change no faster than the way. The exact field is asked, so that no branch or wire
    falls between the points of the grid.
    """
    grid = grid_distances(field, spacing)
    free = grid > radius + spacing / 2
    return are_connected(free, *(cell_of(field, grid, spacing, p) for p in (p_WS, p_WG)))


def cell_of(field: DistanceField, grid: NDArray, spacing: float, p_W: NDArray) -> tuple[int, ...]:
    """The cell of `grid_distances` that p_W (3,) [m] lies in."""
    cell = np.clip(((p_W - field.lower_W) / spacing).astype(int), 0, np.array(grid.shape) - 1)
    return tuple(int(c) for c in cell)


def are_connected(free: NDArray, a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    """Whether steps along the axes lead from cell a to cell b of a grid, all of them `free`."""
    part = np.asarray(label(free)[0])  # pyright: ignore[reportIndexIssue]
    return bool(part[a] == part[b] > 0)


def grid_distances(field: DistanceField, spacing: float) -> NDArray[np.float64]:
    """`conservative_distance` (nx, ny, nz) [m] at lower_W + (i + 0.5) spacing."""
    shape = np.maximum(((field.upper_W - field.lower_W) / spacing + 1e-6).astype(int), 1)
    x, y, z = (
        low + spacing * (np.arange(n) + 0.5) for low, n in zip(field.lower_W, shape, strict=True)
    )
    grid = np.empty(shape)
    for part, p_WQ in cubes_of_points(x, y, z):
        grid[part] = conservative_distance(field, p_WQ)
    return grid
