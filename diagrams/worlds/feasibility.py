"""Checks by grid search that a path from start to goal exists; chooses starts and goals."""

import functools
import logging
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.collision.esdf import Esdf, distance_to_voxels
from splatpilot.systems.collision.esdf_build import cubes_of_points
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import Config
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

_log = logging.getLogger(__name__)

CLEARANCE = 0.8  # [m], minimum distance of start and goal from obstacles and bounds
TRIES = 60  # Maximum number of draws of an instance


def until_feasible[C: Config](
    draw: Callable[[C, int, np.random.Generator], WorldSpec],
) -> Callable[[C, int], WorldSpec]:
    """Decorates a generator of instances: draws a feasible one."""

    @functools.wraps(draw)
    def make(config: C, seed: int) -> WorldSpec:
        for attempt in range(TRIES):
            spec = draw(config, seed, np.random.default_rng([seed, attempt]))
            if is_feasible(spec):
                return spec
        raise InfeasibleFlightError(
            f"none of {TRIES} instances of the world drawn from seed {seed} leaves a vehicle of "
            f"radius {VEHICLE_RADIUS} m a route from start to goal; use fewer or smaller obstacles"
        )

    return make


def is_feasible(spec: WorldSpec) -> bool:
    """Checks that start and goal are clear and that a path joins them."""
    field, ends = spec.distance_field, (spec.p_WS, spec.p_WG)
    if not (conservative_distance(field, np.stack(ends)) >= CLEARANCE).all():
        return False
    # A coarse grid finds most paths; the finest finds those through gaps of 1 m.
    return any(connects(field, *ends, VEHICLE_RADIUS, spacing) for spacing in (0.3, 0.15, 0.12))


def conservative_distance(field: DistanceField, p_WQ: NDArray) -> NDArray[np.float64]:
    """Computes distances (...,) [m] of points (..., 3) in the bounds to surfaces and bounds."""
    to_bounds = np.minimum(p_WQ - field.lower_W, field.upper_W - p_WQ).min(axis=-1)
    return np.minimum(field.distance(p_WQ), to_bounds)


def connects(
    field: DistanceField, p_WS: NDArray, p_WG: NDArray, radius: float, spacing: float
) -> bool:
    """Checks by a grid that a sphere of `radius` [m] can fly from p_WS to p_WG (3,) [m]. Neighbors
    along an axis, `spacing` h [m] apart, both farther than radius + h / 2 from every obstacle, are
    joined by a free segment, since distances change no faster than the position."""
    grid = grid_distances(field, spacing)
    free = grid > radius + spacing / 2
    return are_connected(free, *(grid_cell(field, grid, spacing, p) for p in (p_WS, p_WG)))


def grid_cell(field: DistanceField, grid: NDArray, spacing: float, p_W: NDArray) -> tuple[int, ...]:
    """Returns the cell of `grid_distances` that holds p_W (3,) [m]."""
    cell = np.clip(((p_W - field.lower_W) / spacing).astype(int), 0, np.array(grid.shape) - 1)
    return tuple(int(c) for c in cell)


def are_connected(free: NDArray, a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    """Checks if steps through `free` cells along the axes lead from cell a to cell b."""
    part = np.asarray(label(free)[0])  # pyright: ignore[reportIndexIssue]
    return bool(part[a] == part[b] > 0)


def grid_distances(field: DistanceField, spacing: float) -> NDArray[np.float64]:
    """Computes `conservative_distance` (nx, ny, nz) [m] at lower_W + (i + 0.5) spacing."""
    shape = np.maximum(((field.upper_W - field.lower_W) / spacing + 1e-6).astype(int), 1)
    x, y, z = (
        low + spacing * (np.arange(n) + 0.5) for low, n in zip(field.lower_W, shape, strict=True)
    )
    grid = np.empty(shape)
    for part, p_WQ in cubes_of_points(x, y, z):
        grid[part] = conservative_distance(field, p_WQ)
    return grid


SHORTEST = 1.0  # [m], minimum length of a route
LONG_ENOUGH = 8.0  # [m], minimum length of a representative route, as in the benchmark
_GAIN = 1.5  # minimum ratio of route lengths for which half of the margin is preferred
_MAX_NODES = 250_000
_DRAWS = 20


class _Part(NamedTuple):
    """A connected part of the free space."""

    graph: csr_array  # of all free space
    p_WN: NDArray[np.float64]  # (N, 3) [m], the nodes of the graph
    nodes: NDArray[np.intp]  # of the part
    end: int  # of (nearly) the longest of all shortest paths in the part
    length: float  # [m], of that path


def choose_start_and_goal(
    esdf: Esdf,
    margin: float = 0.2,
    longest: float = 40.0,
    min_length: float = SHORTEST,
    seed: int | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Returns p_WS (3,), p_WG (3,) and the length of the shortest path between them, all in [m].

    They are the ends of (nearly) the longest of all shortest paths, `min_length` to `longest` or
    1.5 `min_length` [m], of the vehicle through known free space, with `margin` [m] to spare or
    half of that. Given a seed, they are drawn: the start from the same part of free
    space, the goal from the nodes whose shortest path is at least 60 % of that.
    """
    longest = max(longest, 1.5 * min_length)
    part = longest_part(esdf, margin, longest, min_length)
    if seed is None:
        goal, length = _farthest(part.graph, part.end, longest)
        return part.p_WN[part.end], part.p_WN[goal], length
    rng = np.random.default_rng(seed)
    desired = max(0.6 * min(part.length, longest), min_length)
    for attempt in range(_DRAWS + 1):
        start = int(rng.choice(part.nodes)) if attempt < _DRAWS else part.end
        lengths = dijkstra(part.graph, directed=False, indices=start, limit=longest)
        far = np.flatnonzero(np.isfinite(lengths) & (lengths >= desired))
        if len(far):
            goal = int(rng.choice(far))
            return part.p_WN[start], part.p_WN[goal], float(lengths[goal])
    raise _infeasible(esdf, margin, part.length, min_length)


def short_route_warning(length: float) -> str:
    """Returns a warning if a route of this length [m] is too short to be representative."""
    if length >= LONG_ENOUGH:
        return ""
    return (
        f"the longest route from a start to a goal is {length:.1f} m, too short to be "
        f"representative (at least {LONG_ENOUGH:g} m); unknown space counts as occupied"
    )


def choose_ends(
    esdf: Esdf, source: object, min_length: float = SHORTEST, seed: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Chooses p_WS and p_WG, or draws them; warns if the longest route of the `source` is short."""
    p_WS, p_WG, length = choose_start_and_goal(esdf, min_length=min_length, seed=seed)
    if seed is None and (warning := short_route_warning(length)):
        _log.warning("%s: %s", source, warning)
    return p_WS, p_WG


def longest_part(
    esdf: Esdf, margin: float = 0.2, longest: float = 40.0, min_length: float = SHORTEST
) -> _Part:
    """Returns the connected part of the free space with the longest path, up to `longest` [m]. Half
    of the margin is preferred for a path `_GAIN` times as long if one is not `LONG_ENOUGH`."""
    best, reach = None, 0.0
    for graph, p_WN, spacing in _free_graphs(esdf, margin):
        if best is not None and best.length >= max(LONG_ENOUGH, min_length):
            break
        _, label = connected_components(graph, directed=False)
        sizes = np.bincount(label)
        for index in np.argsort(-sizes, kind="stable"):
            # No path is longer than one along the diagonals through all nodes of a part.
            if min(np.sqrt(3.0) * spacing * (sizes[index] - 1), longest) <= reach:
                break
            nodes = np.flatnonzero(label == index)
            end, _ = _farthest(graph, int(nodes[0]))
            _, length = _farthest(graph, end)
            if length > reach:
                best, reach = _Part(graph, p_WN, nodes, end, length), length
        reach *= _GAIN
    if best is None or best.length < min_length:
        raise _infeasible(esdf, margin, 0.0 if best is None else best.length, min_length)
    return best


def _free_graphs(
    esdf: Esdf, margin: float
) -> Iterator[tuple[csr_array, NDArray[np.float64], float]]:
    """Yields graphs of the space free for the vehicle, with all and half of `margin`: graph, nodes
    (N, 3) [m] and their spacing [m]. The free spheres about the ends of an edge cover it."""
    # As in `Esdf.conservative`, but for free space alone, which takes a fifth of the time.
    unknown = esdf.states == FieldState.UNKNOWN
    distances = distance_to_voxels(unknown, esdf.voxel_size) - np.float32(0.5 * esdf.voxel_size)
    distances = np.minimum(esdf.distances, distances)
    field = Esdf(distances, esdf.states, esdf.lower_W, esdf.voxel_size)
    extent = esdf.upper_W - esdf.lower_W
    spacing = max(esdf.voxel_size, 0.15, float(np.cbrt(np.prod(extent) / _MAX_NODES)))
    axes = [
        low + spacing * (np.arange(max(int(size / spacing), 1)) + 0.5)
        for low, size in zip(esdf.lower_W, extent, strict=True)
    ]
    p_WN = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (nx, ny, nz, 3)
    clearance = conservative_distance(field, p_WN) - VEHICLE_RADIUS  # [m]
    for need in (margin, margin / 2):
        if np.count_nonzero(clearance > need) >= 2:
            graph, nodes = grid_graph(clearance > need, spacing)
            edges, room = graph.tocoo(), clearance.flat[nodes]
            kept = room[edges.row] + room[edges.col] >= edges.data
            ends = edges.row[kept], edges.col[kept]
            graph = csr_array((edges.data[kept], ends), shape=graph.shape)
            yield graph, p_WN.reshape(-1, 3)[nodes], spacing


def _infeasible(
    esdf: Esdf, margin: float, reach: float, min_length: float
) -> InfeasibleFlightError:
    largest = float(esdf.conservative().distances.max())
    return InfeasibleFlightError(
        f"the longest route of a vehicle of radius {VEHICLE_RADIUS} m with {margin / 2:g} m to "
        f"spare must be at least {min_length:g} m, got {reach:.2f} m; the largest clearance is "
        f"{largest:.2f} m, and unknown space counts as occupied: capture more of the scene"
    )


def grid_graph(free: NDArray[np.bool_], spacing: float) -> tuple[csr_array, NDArray[np.intp]]:
    """Returns the graph [m] of free nodes and their 26 neighbors, and flat indices of the nodes."""
    nodes = np.flatnonzero(free)
    index = np.full(free.shape, -1)
    index.flat[nodes] = np.arange(len(nodes))
    rows, columns, weights = [], [], []
    for offset in np.ndindex(3, 3, 3):
        step = np.array(offset) - 1
        if tuple(step) <= (0, 0, 0):
            continue  # the other half of the neighbors follows by symmetry
        here, there = (
            tuple(slice(max(-s, 0), n - max(s, 0)) for s, n in zip(shift, free.shape, strict=True))
            for shift in (step, -step)
        )
        both = free[here] & free[there]
        rows.append(index[here][both])
        columns.append(index[there][both])
        weights.append(np.full(len(rows[-1]), spacing * np.linalg.norm(step)))
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(coo_array(entries, shape=(len(nodes), len(nodes)))), nodes


def _farthest(graph: csr_array, node: int, longest: float = np.inf) -> tuple[int, float]:
    """Returns the node with the longest shortest path [m] from `node`, and that length [m]."""
    lengths = dijkstra(graph, directed=False, indices=node, limit=longest)
    lengths[np.isinf(lengths)] = -1
    farthest = int(np.argmax(lengths))
    return farthest, float(lengths[farthest])
