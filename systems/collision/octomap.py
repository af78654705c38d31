"""Reads OctoMap's binary trees (.bt) and computes their distance fields.

After the header, each inner node is 16 bits, depth first, two for each of its eight children,
lowest child in the lowest bits: 00 unknown, 01 a free leaf, 10 an occupied leaf, 11 an inner node.
Child c is the part toward +x (c & 1), +y (c & 2), +z (c & 4) of a cube; the root spans 2^16 voxels
an edge about the origin.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy, grid_shape
from splatpilot.systems.common.readers import LFS_ERROR, LFS_POINTER, require_file
from splatpilot.systems.common.validation import errors_about, require

_DEPTH = 16  # levels of children below the root
_FREE, _OCCUPIED, _INNER = 1, 2, 3  # the two bits of a child


@dataclass(frozen=True, eq=False)
class Octomap:
    """The leaves of an occupancy octree: cubes of known space."""

    resolution: float  # [m] edge length of the smallest voxel
    corners: np.ndarray  # (N, 3) int, lower corner of each leaf in voxels from the world's origin
    sizes: np.ndarray  # (N,) int, edge length of each leaf in voxels, a power of two
    occupied: np.ndarray  # (N,) bool, the others are free

    @property
    def lower_W(self) -> np.ndarray:
        """Lower corner of the known space (3,) [m]."""
        return self.resolution * self.corners.min(axis=0)

    @property
    def upper_W(self) -> np.ndarray:
        """Upper corner of the known space (3,) [m]."""
        return self.resolution * (self.corners + self.sizes[:, None]).max(axis=0)

    def part(self, max_voxels: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the corners (3,) [m] of a box of at most `max_voxels` about the free space: the
        map's, or as high as the map and of its proportions."""
        lower, upper = self.corners.min(axis=0), (self.corners + self.sizes[:, None]).max(axis=0)
        shape = (upper - lower).astype(float)
        shrunk = np.sqrt(min(1.0, max_voxels / shape.prod())) * shape[:2]
        free = ~self.occupied if not self.occupied.all() else self.occupied
        volume = self.sizes[free].astype(float) ** 3
        centers = self.corners[free] + 0.5 * self.sizes[free, None]
        for axis in range(2):
            order = np.argsort(centers[:, axis])
            filled = np.cumsum(volume[order])
            middle = centers[order[np.searchsorted(filled, 0.5 * filled[-1])], axis]
            half = 0.5 * shrunk[axis]
            middle = np.clip(middle, lower[axis] + half, upper[axis] - half)
            lower[axis], upper[axis] = np.ceil(middle - half), np.floor(middle + half)
        return self.resolution * lower, self.resolution * upper

    def esdf(self, lower_W: np.ndarray | None = None, upper_W: np.ndarray | None = None) -> Esdf:
        """Computes the distance field of a box, by default all the known space, at the map's
        resolution; its corners are rounded outwards to a voxel."""
        lower_W = self.lower_W if lower_W is None else np.asarray(lower_W, dtype=float)
        upper_W = self.upper_W if upper_W is None else np.asarray(upper_W, dtype=float)
        lower = np.floor(lower_W / self.resolution + 1e-6).astype(int)
        upper = np.ceil(upper_W / self.resolution - 1e-6).astype(int)
        shape = grid_shape(lower * self.resolution, upper * self.resolution, self.resolution)
        states = np.full(shape, FieldState.UNKNOWN, dtype=np.uint8)
        value = np.where(self.occupied, FieldState.OCCUPIED, FieldState.FREE).astype(np.uint8)
        for size in np.unique(self.sizes):
            of_size = self.sizes == size
            start = np.maximum(self.corners[of_size] - lower, 0)
            stop = np.minimum(self.corners[of_size] - lower + size, shape)
            inside = (start < stop).all(axis=1)
            start, stop, leaves = start[inside], stop[inside], value[of_size][inside]
            if size == 1:
                states[tuple(start.T)] = leaves
                continue
            for a, b, leaf in zip(start.tolist(), stop.tolist(), leaves.tolist(), strict=True):
                states[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = leaf
        occupied, unknown = states == FieldState.OCCUPIED, states == FieldState.UNKNOWN
        return esdf_from_occupancy(occupied, unknown, self.resolution * lower, self.resolution)


def read_octomap(path: str | Path) -> Octomap:
    """Reads a binary OctoMap (.bt) file; raises ValueError for other, damaged or empty files."""
    path = Path(path)
    require_file(path)
    content = path.read_bytes()
    header, separator, tree = content.partition(b"\ndata\n")
    lines = header.split(b"\n")
    start = b"# Octomap OcTree binary file"
    if content.startswith(LFS_POINTER):
        raise ValueError(f"{path}: {LFS_ERROR}")
    valid = separator and lines[0].startswith(start)
    require(valid, f"{path}: start", f"{start.decode()!r} of a binary OctoMap", content[:20])
    entries = dict(
        line.decode("ascii", "replace").split(maxsplit=1)
        for line in lines
        if not line.startswith(b"#") and len(line.split()) >= 2
    )
    try:
        kind, count, resolution = entries["id"], int(entries["size"]), float(entries["res"])
    except (KeyError, ValueError):
        raise ValueError(f"{path}: header must have id, size and res, got {entries}") from None
    require(kind.strip() == "OcTree", f"{path}: id", "OcTree", kind)
    require(0.0 < resolution < np.inf, f"{path}: res", "in (0, inf) m", resolution)
    masks = np.frombuffer(tree, dtype="<u2", count=len(tree) // 2)
    links = _links(masks)
    size = f"{path}: size of the octree"
    require(2 * len(links) == len(tree) > 0, size, f"{2 * len(links)} bytes", len(tree))
    with errors_about(path):
        corners, sizes, occupied = _leaves(masks, links)
    nodes = len(masks) + len(sizes)
    require(nodes == count, f"{path}: number of nodes", f"size = {count}", nodes)
    return Octomap(resolution, corners, sizes, occupied)


def _links(masks: np.ndarray) -> np.ndarray:
    """Returns 8 * parent + number as a child of each inner node in file order; -1 for the root.

    A tree with missing nodes has links for them too, one with further ones has fewer than masks.
    """
    children = {  # last child first: the stack returns them in order
        mask: [c for c in range(7, -1, -1) if mask >> 2 * c & 3 == _INNER]
        for mask in np.unique(masks).tolist()
    }
    links, stack = [], [-1]
    for index, mask in enumerate(masks.tolist()):
        if not stack:
            break
        links.append(stack.pop())
        stack += [8 * index + child for child in children[mask]]
    return np.array(links + stack)


def _leaves(masks: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns corners (N, 3), sizes (N,) and occupancy (N,) of the leaves."""
    parent, number = links >> 3, links & 7
    corner = np.zeros((len(masks), 3), dtype=np.int64)
    corner[0] = -(2 ** (_DEPTH - 1))
    level = np.full(len(masks), _DEPTH)
    level[0] = 0
    bits = np.array([0, 1, 2])
    nodes = np.array([0])
    for depth in range(1, _DEPTH):
        of_level = np.zeros(len(masks), dtype=bool)
        of_level[nodes] = True
        nodes = 1 + np.flatnonzero(of_level[parent[1:]])
        level[nodes] = depth
        step = 2 ** (_DEPTH - depth) * (number[nodes, None] >> bits & 1)
        corner[nodes] = corner[parent[nodes]] + step
    require(level.max() < _DEPTH, "depth of the octree", f"at most {_DEPTH}", "more")
    child = masks[:, None] >> (2 * np.arange(8)) & 3  # (inner nodes, 8)
    node, octant = np.nonzero((child == _FREE) | (child == _OCCUPIED))
    size = 2 ** (_DEPTH - 1 - level[node])
    corners = corner[node] + size[:, None] * (octant[:, None] >> bits & 1)
    return corners, size, child[node, octant] == _OCCUPIED
