"""Where to fly from and to in a world of which only the free space is known."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from splatpilot.systems.collision.esdf import Esdf

SHORTEST = 1.0
"""[m], length of the shortest way that is worth a flight."""

_MAX_NODES = 250_000
_DRAWS = 20


def choose_start_and_goal(
    esdf: Esdf, radius: float, margin: float = 0.2, longest: float = 40.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Returns p_WS (3,), p_WG (3,) and the length of the shortest path between them, all in [m].

    The ends of (nearly) the longest of all shortest paths that a sphere of `radius` with `margin`
    [m] to spare can fly through space known to be free, at least `SHORTEST`: in the largest
    connected part of a grid, the node farthest from any node, and the node farthest from that (the
    double sweep, exact on trees). If no space has that much margin, half of it is tried: through
    less, vehicles hover before gaps that planners do not trust. Paths longer than `longest` [m] are
    not considered: a flight should end in good time.

    Raises:
        ValueError: if no free space holds a sphere of `radius` and lets it fly so far.
    """
    reach = 0.0
    for graph, p_WN in _free_graphs(esdf, radius, margin):
        _, label = connected_components(graph, directed=False)
        inner = int(np.argmax(label == np.bincount(label).argmax()))
        start, _ = _farthest(graph, inner)
        goal, length = _farthest(graph, start, longest)
        if length >= SHORTEST:
            return p_WN[start], p_WN[goal], length
        reach = max(reach, length)
    raise _no_room(esdf, radius, margin, reach, SHORTEST)


def draw_start_and_goal(
    esdf: Esdf,
    radius: float,
    seed: int,
    margin: float = 0.2,
    longest: float = 40.0,
    least: float = SHORTEST,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Returns p_WS (3,), p_WG (3,) and the length of the shortest path between them, all in [m].

    As `choose_start_and_goal`, but anywhere: the start is drawn from the largest connected part of
    free space, the goal from those nodes whose shortest path from it is at least 60 % of the
    longest there is, up to `longest` [m], and at least `least` [m]. The same seed gives the same
    bits; where no start in so many draws has such a goal, it is an end of the longest path.

    Raises:
        ValueError: if no free space holds a sphere of `radius` and lets it fly so far.
    """
    rng = np.random.default_rng(seed)
    reach = 0.0
    for graph, p_WN in _free_graphs(esdf, radius, margin):
        _, label = connected_components(graph, directed=False)
        part = np.flatnonzero(label == np.bincount(label).argmax())
        end, _ = _farthest(graph, int(part[0]))
        _, length = _farthest(graph, end)
        reach = max(reach, length)
        for attempt in range(_DRAWS + 1):
            start = int(rng.choice(part)) if attempt < _DRAWS else end
            lengths = dijkstra(graph, directed=False, indices=start, limit=longest)
            wanted = max(0.6 * min(length, longest), least)
            far = np.flatnonzero(np.isfinite(lengths) & (lengths >= wanted))
            if len(far):
                goal = int(rng.choice(far))
                return p_WN[start], p_WN[goal], float(lengths[goal])
    raise _no_room(esdf, radius, margin, reach, least)


def _free_graphs(
    esdf: Esdf, radius: float, margin: float
) -> Iterator[tuple[csr_array, NDArray[np.float64]]]:
    """Graphs of the space free for a sphere of `radius` [m], and their nodes (N, 3) [m], with ever
    less margin: all of `margin` [m] and half of it."""
    field = esdf.conservative()
    extent = esdf.upper_W - esdf.lower_W
    spacing = max(esdf.voxel_size, 0.15, float(np.cbrt(np.prod(extent) / _MAX_NODES)))
    axes = [
        low + spacing * (np.arange(max(int(size / spacing), 1)) + 0.5)
        for low, size in zip(esdf.lower_W, extent, strict=True)
    ]
    p_WN = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (nx, ny, nz, 3)
    clearance = field.distance(p_WN) - radius  # [m]
    for need in (margin, margin / 2):
        if np.count_nonzero(clearance > need) >= 2:
            graph, nodes = grid_graph(clearance > need, spacing)
            yield graph, p_WN.reshape(-1, 3)[nodes]


def _no_room(esdf: Esdf, radius: float, margin: float, reach: float, least: float) -> ValueError:
    room = f"a vehicle of radius {radius} m with {margin / 2:g} m to spare"
    if reach > 0:
        return ValueError(
            f"the longest way of {room} through free space is {reach:.2f} m, at least {least:g} m "
            "is needed, and unknown space counts as occupied; capture more of the place"
        )
    largest = float(esdf.conservative().distances.max())
    return ValueError(
        f"no free space for {room}: the largest clearance is {largest:.2f} m, and unknown space "
        "counts as occupied; capture more of the place"
    )


def grid_graph(free: NDArray[np.bool_], spacing: float) -> tuple[csr_array, NDArray[np.intp]]:
    """Returns the graph that joins each free node to its free neighbours among the 26 around it,
    weighted by distance [m], and the flat index of each of its nodes."""
    nodes = np.flatnonzero(free)
    number = np.full(free.shape, -1)
    number.flat[nodes] = np.arange(len(nodes))
    rows, columns, weights = [], [], []
    for offset in np.ndindex(3, 3, 3):
        step = np.array(offset) - 1
        if tuple(step) <= (0, 0, 0):
            continue  # the other half of the neighbours follows by symmetry
        here = tuple(
            slice(max(-s, 0), n - max(s, 0)) for s, n in zip(step, free.shape, strict=True)
        )
        there = tuple(
            slice(max(s, 0), n - max(-s, 0)) for s, n in zip(step, free.shape, strict=True)
        )
        both = free[here] & free[there]
        rows.append(number[here][both])
        columns.append(number[there][both])
        weights.append(np.full(len(rows[-1]), spacing * np.linalg.norm(step)))
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(coo_array(entries, shape=(len(nodes), len(nodes)))), nodes


def _farthest(graph: csr_array, node: int, longest: float = np.inf) -> tuple[int, float]:
    """Returns the node with the longest shortest path from `node` of at most `longest` [m], and the
    length of that [m]."""
    lengths = dijkstra(graph, directed=False, indices=node, limit=longest)
    lengths[np.isinf(lengths)] = -1
    farthest = int(np.argmax(lengths))
    return farthest, float(lengths[farthest])
