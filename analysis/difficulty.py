"""Difficulty of flights from start to goal, measured in worlds.

AvoidBench: H. Yu, G. C. H. E. de Croon, C. De Wagter, "AvoidBench: A high-fidelity vision-based
obstacle avoidance benchmarking suite for multi-rotors", ICRA 2023; its traversability is that of
C. Nous et al., "Performance evaluation in obstacle avoidance", IROS 2016.
FlightBench: S.-A. Yu et al., arXiv:2406.05687, 2024, with the constants of its published program:
a sensing range of 4 m and a field of view of 72 degrees.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
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
from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.time_of_arrival import path_lengths
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

SPACING = 0.2  # [m], of the grid for path search
SENSING_RANGE = 4.0  # [m], of FlightBench's measures
_RINGS = np.pi / np.array([5.0, 6.0, 8.0, 12.0])
"""[rad] Outer half angles of the rings about the heading; the last one is a full cone."""
_RING_WEIGHTS = np.array([0.05, 0.10, 0.30, 0.55])
_NEIGHBORS = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]) - 1.0


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
    """Computes all measures of flights from p_WS to p_WG (3,) [m]; InfeasibleFlightError without a
    path."""
    grid = grid_distances(field, SPACING)
    path = shortest_path(field, grid, p_WS, p_WG)
    return Difficulty(
        traversability=traversability(field, np.random.default_rng(seed)),
        relative_gap_size=relative_gap_size(field, float((p_WS[2] + p_WG[2]) / 2)),
        traversability_obstacle=traversability_obstacle(field, path),
        view_obstacle=view_obstacle(field, path),
        angle_over_length=angle_over_length(path),
        detour_ratio=float(path_length(path) / np.linalg.norm(p_WG - p_WS)),
        bottleneck_m=bottleneck(field, grid, p_WS, p_WG),
    )


def world_difficulty(world: World, p_WS: NDArray, p_WG: NDArray, seed: int) -> Difficulty:
    """Computes `difficulty` in a world, in which unknown space of grids counts as occupied."""
    field = world.distance_field
    return difficulty(field.conservative() if isinstance(field, Esdf) else field, p_WS, p_WG, seed)


def shortest_path(field: DistanceField, grid: NDArray, p_WS: NDArray, p_WG: NDArray) -> NDArray:
    """Returns points (K, 3) [m] of a shortest path for the vehicle, found on `grid_distances` and
    shortened by straight segments that are free in the exact field."""
    states = np.where(grid > 0, FieldState.FREE, FieldState.OCCUPIED).astype(np.uint8)
    esdf = Esdf(grid.astype(np.float32), states, np.asarray(field.lower_W, float), SPACING)
    lengths = path_lengths(esdf.conservative(), p_WG)
    if not lengths.is_reachable(p_WS):
        raise InfeasibleFlightError(
            f"no path from start to goal was found on a grid of {SPACING:g} m"
        )
    points, _ = lengths.path(p_WS, np.arange(SPACING, float(lengths.value(p_WS)), SPACING))
    points = np.concatenate([p_WS[None], points, p_WG[None]])
    kept = [0]
    while (first := kept[-1]) < len(points) - 1:
        step, last = 1, len(points) - 1 - first
        while 2 * step <= last and _is_free(field, points[first], points[first + 2 * step]):
            step *= 2
        low, high = step, min(2 * step, last)
        while low < high:  # bisects for the farthest visible point
            middle = (low + high + 1) // 2
            visible = _is_free(field, points[first], points[first + middle])
            low, high = (middle, high) if visible else (low, middle - 1)
        kept.append(first + low)
    return points[kept]


def _is_free(field: DistanceField, p_A: NDArray, p_B: NDArray) -> bool:
    points = np.linspace(p_A, p_B, max(int(np.linalg.norm(p_B - p_A) / 0.05), 2))
    return bool((conservative_distance(field, points) > VEHICLE_RADIUS).all())


def march(
    field: DistanceField, p_W: NDArray, directions: NDArray, radius: float, longest: float
) -> NDArray:
    """Computes by sphere tracing how far (N,) [m] spheres fly from p_W (N, 3) [m] in `directions`
    (N, 3), until they touch a surface or their center leaves the bounds, at most `longest` [m]."""
    flown, moving = np.zeros(len(p_W)), np.arange(len(p_W))
    for _ in range(200):
        p = p_W[moving] + flown[moving, None] * directions[moving]
        free = np.where(_is_inside(field, p), field.distance(p), -np.inf) - radius
        moving, free = moving[free > 0.01], free[free > 0.01]
        flown[moving] = np.minimum(flown[moving] + free, longest)
        moving = moving[flown[moving] < longest]
        if not len(moving):
            break
    bounds_W = np.where(directions > 0, field.upper_W, field.lower_W)
    slopes = np.where(directions == 0, 1.0, directions)
    to_bounds = np.where(directions == 0, np.inf, (bounds_W - p_W) / slopes).min(axis=1)
    return np.minimum(flown, to_bounds)


def path_length(path: NDArray) -> float:
    """Computes the length [m] of the path (K, 3) [m]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def resample(path: NDArray, step: float) -> NDArray:
    """Returns points (N, 3) on the path (K, 3), about `step` [m] apart, with both ends."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    s = np.linspace(0.0, at[-1], max(int(np.ceil(at[-1] / step)), 1) + 1)
    return np.column_stack([np.interp(s, at, path[:, k]) for k in range(3)])


def _is_inside(field: DistanceField, p_W: NDArray) -> NDArray[np.bool_]:
    return ((p_W >= field.lower_W) & (p_W <= field.upper_W)).all(axis=-1)


def traversability(field: DistanceField, rng: np.random.Generator, samples: int = 300) -> float:
    """Computes AvoidBench's traversability, (1 / n r) sum_i s_i; high is easy. s_i [m] is how far
    the vehicle of radius r flies in a random horizontal direction, from a random point where it
    fits, until it touches an obstacle or reaches the bounds."""
    p = rng.uniform(field.lower_W, field.upper_W, (20 * samples, 3))
    p = p[conservative_distance(field, p) > VEHICLE_RADIUS][:samples]
    angle = rng.uniform(0, 2 * np.pi, len(p))
    directions = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(p))])
    longest = float(np.linalg.norm(field.upper_W - field.lower_W))
    return float(march(field, p, directions, VEHICLE_RADIUS, longest).mean() / VEHICLE_RADIUS)


def relative_gap_size(field: DistanceField, height: float) -> float:
    """Computes the mean gap between an obstacle and its nearest neighbor, in vehicle diameters.
    Obstacles are the connected parts of the occupied space in the slice z = `height` [m], on a grid
    of 0.1 m. NaN for fewer than two."""
    step = 0.1
    x, y = (
        np.arange(low + step / 2, high, step)
        for low, high in zip(field.lower_W[:2], field.upper_W[:2], strict=True)
    )
    plane = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    p = np.concatenate([plane, np.full((*plane.shape[:2], 1), height)], axis=-1)
    # Obstacles thinner than a cell are grown to one.
    part = np.asarray(label(field.distance(p) < step / 2)[0])  # pyright: ignore[reportIndexIssue]
    gaps = []
    for k in range(1, int(part.max()) + 1):
        others = plane[(part > 0) & (part != k)]
        if len(others):
            gap, _ = KDTree(others).query(plane[part == k])
            gaps.append(max(float(np.min(gap)) - step, 0.0))
    return float(np.mean(gaps)) / (2 * VEHICLE_RADIUS) if gaps else float("nan")


def traversability_obstacle(field: DistanceField, path: NDArray) -> float:
    """Computes FlightBench's TO: (R / 2N) sum of 1 / r_i over the N narrower half of the spheres of
    a corridor along the path (K, 3) [m]; R is the sensing range. High is hard.

    The radius of a sphere is the clearance at its center, 5 cm to R. Its center is the best of 53
    points up to 0.5 m around the point where the path leaves the previous sphere. FlightBench
    draws 40 at random.
    """
    points = resample(path, 0.05)
    directions = _NEIGHBORS / np.linalg.norm(_NEIGHBORS, axis=1, keepdims=True)
    offsets = np.concatenate([np.zeros((1, 3)), 0.25 * directions, 0.5 * directions])
    radii, row = [], 0
    while True:
        centers = points[row] + offsets
        clearance = np.full(len(centers), -np.inf)
        inside = _is_inside(field, centers)
        clearance[inside] = conservative_distance(field, centers[inside]) - VEHICLE_RADIUS
        best = int(np.argmax(clearance))
        radii.append(float(np.clip(clearance[best], 0.05, SENSING_RANGE)))
        outside = np.linalg.norm(points[row + 1 :] - centers[best], axis=1) >= radii[-1]
        if not outside.any():
            break
        row += 1 + int(np.argmax(outside))
    narrow = np.sort(radii)[: max(len(radii) // 2, 1)]
    return float(SENSING_RANGE / 2 * np.mean(1 / narrow))


def view_obstacle(field: DistanceField, path: NDArray) -> float:
    """Computes FlightBench's VO, the mean proximity of obstacles in the view along the path (K, 3)
    [m]: sum_k w_k R / d_k at every tenth of the sensing range R. d_k is the distance to the nearest
    surface within R in ring k (`_RINGS`), found along 8 rays of each ring and one ahead.
    """
    points = resample(path, SENSING_RANGE / 10)
    ahead = np.diff(points, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, np.where(np.abs(ahead[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, ahead)
    middles = 0.5 * (_RINGS + np.append(_RINGS[1:], 0.0))
    total = np.zeros(len(ahead))
    for angle, weight in zip(middles, _RING_WEIGHTS, strict=True):
        nearest = np.full(len(ahead), np.inf)
        rays = [
            np.cos(angle) * ahead + np.sin(angle) * (np.cos(t) * side + np.sin(t) * up)
            for t in np.arange(8) * np.pi / 4
        ]
        for ray in rays if angle > middles[-1] else [*rays, ahead]:
            depth = march(field, points[:-1], ray, 0.0, SENSING_RANGE)
            ends = points[:-1] + depth[:, None] * ray
            solid = (depth < SENSING_RANGE) & _is_inside(field, ends)
            solid &= field.distance(ends) < 0.02
            nearest = np.minimum(nearest, np.where(solid, np.maximum(depth, 0.05), np.inf))
        total += weight * SENSING_RANGE / nearest
    return float(total.mean())


def angle_over_length(path: NDArray) -> float:
    """Computes FlightBench's AOL [1/m] of the path (K, 3) [m]: the sum of exp(2 theta / pi) - 1
    over all bends theta, over the length."""
    steps = np.diff(path, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    theta = np.arccos(np.clip(np.einsum("ki,ki->k", steps[1:], steps[:-1]), -1, 1))
    return float(np.expm1(2 * theta / np.pi).sum() / path_length(path))


def bottleneck(field: DistanceField, grid: NDArray, p_WS: NDArray, p_WG: NDArray) -> float:
    """Computes by bisection to 1 cm the largest clearance [m], beyond the vehicle's radius, of any
    path on `grid_distances`. The grid may miss the middle of a gap by half a cell."""
    ends = [grid_cell(field, grid, SPACING, p) for p in (p_WS, p_WG)]
    low, high = 0.0, float(min(grid[end] for end in ends))
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if are_connected(grid >= middle, *ends) else (low, middle)
    return low - VEHICLE_RADIUS


def run(*, scenarios: Sequence[str], seeds: int) -> None:
    """Prints for each scenario how many seeds are feasible, the mean time of generation and the
    mean difficulty. Scenarios without their scene are not run."""
    names = ("trav", "gap", "TO", "VO", "AOL", "detour", "neck m")
    print(f"{'scenario':<10}{'feasible':>10}{'CPU s':>7}", *(f"{n:>8}" for n in names), sep="")
    for file in [scenario_file(name) for name in scenarios or benchmark_scenarios()]:
        try:
            measured = _measure(file, seeds)
        except FileNotFoundError as error:
            measured = f" not run: {error}"
        print(f"{file.stem:<10}{measured}", flush=True)


def _measure(file: Path, seeds: int) -> str:
    import pandas as pd

    config = load_config(Scenario(), file).world
    rows, spent = [], []
    for seed in Progress(range(seeds), f"measuring {file.stem}", unit="world", leave=False):
        started = time.process_time()
        with suppress(InfeasibleFlightError):
            try:
                world = make_world(config, seed)
            finally:
                spent.append(time.process_time() - started)
            rows.append(astuple(world_difficulty(world, world.p_WS, world.p_WG, seed)))
    # Worlds may be without some measures, which pandas leaves out.
    means = pd.DataFrame(rows, columns=[field.name for field in fields(Difficulty)]).mean()
    columns = f"{f'{len(rows)}/{seeds}':>10}{np.mean(spent):>7.2f}"
    return columns + "".join(f"{mean:>8.2f}" for mean in means)
