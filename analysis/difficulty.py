"""How hard a flight from start to goal is, before anyone flies it.

AvoidBench: H. Yu, G. C. H. E. de Croon, C. De Wagter, "AvoidBench: A high-fidelity vision-based
obstacle avoidance benchmarking suite for multi-rotors", ICRA 2023; its traversability is that of
C. Nous et al., "Performance evaluation in obstacle avoidance", IROS 2016.
FlightBench: S.-A. Yu et al., arXiv:2406.05687, 2024, with the constants of its published program:
a sensing range of 4 m and a field of view of 72 degrees.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import skfmm
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import KDTree

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.feasibility import (
    are_connected,
    conservative_distance,
    grid_cell,
    grid_distances,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

SPACING = 0.2
"""[m], of the grid on which ways are searched."""


def shortest_path(field: DistanceField, grid: NDArray, p_WS: NDArray, p_WG: NDArray) -> NDArray:
    """Points (K, 3) [m] of a shortest way for the vehicle: down the solution of the eikonal
    equation on the grid of distances, then pulled straight where the exact field allows it.

    Raises:
        InfeasibleFlightError: if there is none on the grid.
    """
    shape, goal = grid.shape, grid_cell(field, grid, SPACING, p_WG)
    front = np.ones(shape)
    front[goal] = -1.0
    blocked = grid < VEHICLE_RADIUS + 0.02
    blocked[goal] = False
    marched = skfmm.distance(np.ma.MaskedArray(front, mask=blocked), dx=SPACING)
    length = np.where(np.ma.getmaskarray(marched), np.inf, np.ma.getdata(marched))
    cell = grid_cell(field, grid, SPACING, p_WS)
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
    until it touches a surface or its center leaves the bounds, at most `longest`, by sphere
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


SENSING_RANGE = 4.0
"""[m], of FlightBench's measures."""

_RINGS = np.pi / np.array([5.0, 6.0, 8.0, 12.0])
"""[rad], outer half angles of the rings about the heading; the last one is a full cone."""
_RING_WEIGHTS = np.array([0.05, 0.10, 0.30, 0.55])


@dataclass(frozen=True)
class Difficulty:
    """Measures of one flight; each is defined at the function of its name."""

    traversability: float
    relative_gap_size: float
    traversability_obstacle: float
    view_obstacle: float
    angle_over_length: float
    detour_ratio: float
    bottleneck_m: float


def difficulty(field: DistanceField, p_WS: NDArray, p_WG: NDArray, seed: int = 0) -> Difficulty:
    """All measures of flights from p_WS to p_WG (3,) [m]; `seed` draws AvoidBench's samples.

    Raises:
        InfeasibleFlightError: if no path is found.
    """
    grid = grid_distances(field, SPACING)
    path = shortest_path(field, grid, p_WS, p_WG)
    height = float((p_WS[2] + p_WG[2]) / 2)
    return Difficulty(
        traversability=traversability(field, np.random.default_rng(seed)),
        relative_gap_size=relative_gap_size(field, height),
        traversability_obstacle=traversability_obstacle(field, path),
        view_obstacle=view_obstacle(field, path),
        angle_over_length=angle_over_length(path),
        detour_ratio=float(path_length(path) / np.linalg.norm(p_WG - p_WS)),
        bottleneck_m=bottleneck(field, grid, p_WS, p_WG),
    )


def traversability(field: DistanceField, rng: np.random.Generator, samples: int = 300) -> float:
    """Mean way, in vehicle radii, that the vehicle flies from a random place in a random direction
    until it touches something or the end of the volume: (1 / n r) sum_i s_i. High is easy.

    Places are uniform over those where the vehicle fits; directions are horizontal.
    """
    p = rng.uniform(field.lower_W, field.upper_W, (20 * samples, 3))
    p = p[conservative_distance(field, p) > VEHICLE_RADIUS][:samples]
    angle = rng.uniform(0, 2 * np.pi, len(p))
    way = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(p))])
    longest = float(np.linalg.norm(field.upper_W - field.lower_W))
    flown = march(field, p, way, VEHICLE_RADIUS, longest)
    return float(flown.mean() / VEHICLE_RADIUS)


def relative_gap_size(field: DistanceField, height: float) -> float:
    """Mean gap between an obstacle and its nearest neighbor, in diameters of the vehicle.

    AvoidBench's obstacles stand upright; here they are the connected parts of what is occupied in
    the slice z = `height` [m], on a grid of 0.1 m, with everything thinner than a cell grown to
    one. NaN for fewer than two.
    """
    step = 0.1
    x, y = (
        np.arange(low + step / 2, high, step)
        for low, high in zip(field.lower_W[:2], field.upper_W[:2], strict=True)
    )
    plane = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    p = np.concatenate([plane, np.full((*plane.shape[:2], 1), height)], axis=-1)
    part = np.asarray(label(field.distance(p) < step / 2)[0])  # pyright: ignore[reportIndexIssue]
    gaps = []
    for k in range(1, int(part.max()) + 1):
        others = plane[(part > 0) & (part != k)]
        if len(others):
            gap, _ = KDTree(others).query(plane[part == k])
            gaps.append(max(float(np.min(gap)) - step, 0.0))
    return float(np.mean(gaps)) / (2 * VEHICLE_RADIUS) if gaps else float("nan")


def traversability_obstacle(field: DistanceField, path: NDArray) -> float:
    """FlightBench's TO: (R / 2N) sum of 1 / r_i over the N narrower half of the balls of a corridor
    along the path (K, 3) [m]; R is the sensing range. High is hard.

    A ball's radius is the clearance at its center, 5 cm to R. Each is about the place where the
    path leaves the ball before. FlightBench draws 40 centers about it at random and takes the best;
    here they are the 52 at 0.25 and 0.5 m from it in fixed directions: a path has one value.
    """
    points = resampled(path, 0.05)
    directions = np.array([o for o in np.ndindex(3, 3, 3) if o != (1, 1, 1)]) - 1.0
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    offsets = np.concatenate([np.zeros((1, 3)), 0.25 * directions, 0.5 * directions])
    radii, row = [], 0
    while True:
        centers = points[row] + offsets
        clearance = np.full(len(centers), -np.inf)
        within = inside(field, centers)
        clearance[within] = conservative_distance(field, centers[within]) - VEHICLE_RADIUS
        best = int(np.argmax(clearance))
        radii.append(float(np.clip(clearance[best], 0.05, SENSING_RANGE)))
        away = np.linalg.norm(points[row + 1 :] - centers[best], axis=1) >= radii[-1]
        if not away.any():
            break
        row += 1 + int(np.argmax(away))
    narrow = np.sort(radii)[: max(len(radii) // 2, 1)]
    return float(SENSING_RANGE / 2 * np.mean(1 / narrow))


def view_obstacle(field: DistanceField, path: NDArray) -> float:
    """FlightBench's VO: how near obstacles are in the view along the path (K, 3) [m], in mean.

    At every tenth of the sensing range R, looking along the path, sum_k w_k R / d_k: d_k is the
    distance to the nearest surface in ring k of the field of view (half angles of 36, 30, 22.5 and
    15 degrees inwards, w = 0.05, 0.1, 0.3, 0.55), nothing beyond R counts. Surfaces are found
    along 8 rays a ring and one ahead.
    """
    points = resampled(path, SENSING_RANGE / 10)
    ahead = np.diff(points, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, np.where(np.abs(ahead[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, ahead)
    middles = 0.5 * (_RINGS + np.append(_RINGS[1:], 0.0))
    total = np.zeros(len(ahead))
    for angle, weight in zip(middles, _RING_WEIGHTS, strict=True):
        nearest = np.full(len(ahead), np.inf)
        turns = np.arange(8) * np.pi / 4
        rays = [
            np.cos(angle) * ahead + np.sin(angle) * (np.cos(t) * side + np.sin(t) * up)
            for t in turns
        ]
        for ray in rays if angle > middles[-1] else [*rays, ahead]:
            way = march(field, points[:-1], ray, 0.0, SENSING_RANGE)
            ends = points[:-1] + way[:, None] * ray
            solid = (way < SENSING_RANGE) & inside(field, ends) & (field.distance(ends) < 0.02)
            nearest = np.minimum(nearest, np.where(solid, np.maximum(way, 0.05), np.inf))
        total += weight * SENSING_RANGE / nearest
    return float(total.mean())


def angle_over_length(path: NDArray) -> float:
    """FlightBench's AOL [1/m]: the sum over all bends theta of the path (K, 3) of
    exp(2 theta / pi) - 1, over the length of the path."""
    ways = np.diff(path, axis=0)
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    theta = np.arccos(np.clip(np.einsum("ki,ki->k", ways[1:], ways[:-1]), -1, 1))
    return float(np.expm1(2 * theta / np.pi).sum() / path_length(path))


def bottleneck(field: DistanceField, grid: NDArray, p_WS: NDArray, p_WG: NDArray) -> float:
    """Largest clearance [m], beyond the vehicle's radius, that some way on the grid keeps
    everywhere; found by bisection to 1 cm. The grid may miss the middle of a gap by half a cell."""
    ends = [grid_cell(field, grid, SPACING, p) for p in (p_WS, p_WG)]
    low, high = 0.0, float(min(grid[end] for end in ends))
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if are_connected(grid >= middle, *ends) else (low, middle)
    return low - VEHICLE_RADIUS


def _trusted_field(world: World) -> DistanceField:
    """The exact field of a generated world; of others the grid, unknown space counting as full."""
    field = world.distance_field
    return field.conservative() if isinstance(field, Esdf) else field


def run(*, scenarios: Sequence[str], seeds: int) -> list[str]:
    """Prints how many of `seeds` seeds are feasible, the mean time of generation and the mean
    difficulty of the feasible ones.

    Args:
        scenarios: ids (P01 to P12, R13 to R17), or files; all that come with the program if empty.

    Returns:
        The lines of the table. Scenes that are not there are said to be not run.

    Raises:
        ValueError, FileNotFoundError: for a scenario that does not exist or cannot be made.
    """
    files = [scenario_file(name) for name in scenarios or benchmark_scenarios()]
    names = ("trav", "gap", "TO", "VO", "AOL", "detour", "neck m")
    head = f"{'scenario':<10}{'feasible':>10}{'CPU s':>7}" + "".join(f"{n:>8}" for n in names)
    lines = [head]
    print(head, flush=True)
    for file in files:
        world_config = load_config(Scenario(), file).world
        rows, spent = [], []
        try:
            for seed in Progress(range(seeds), f"measuring {file.stem}", unit="world", leave=False):
                started = time.process_time()
                with suppress(InfeasibleFlightError):
                    try:
                        world = make_world(world_config, seed)
                    finally:
                        spent.append(time.process_time() - started)
                    known = _trusted_field(world)
                    measured = difficulty(known, world.p_WS, world.p_WG, seed)
                    rows.append(list(vars(measured).values()))
        except FileNotFoundError as error:
            lines.append(f"{file.stem:<10} not run: {error}")
            print(lines[-1], flush=True)
            continue
        means = np.mean(rows, axis=0) if rows else np.full(len(names), np.nan)
        feasible = f"{len(rows)}/{seeds}"
        lines.append(
            f"{file.stem:<10}{feasible:>10}{np.mean(spent):>7.2f}"
            + "".join(f"{m:>8.2f}" for m in means)
        )
        print(lines[-1], flush=True)
    return lines
