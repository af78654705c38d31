"""Exact Euclidean distance transforms of voxel grids, with surfaces placed within the voxels."""

import itertools

import edt
import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter

from splatpilot.systems.collision.distance_field import FieldState

_SLAB = 32  # [voxels] along x per batch, to save memory


def neighbor_slices(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Returns the slices of all voxels but the last, and but the first, along an axis."""
    parts = slice(None, -1), slice(1, None)
    return tuple(  # pyright: ignore[reportReturnType]
        tuple(part if a == axis else slice(None) for a in range(3)) for part in parts
    )


def distance_to_voxels(voxels: np.ndarray, voxel_size: float) -> np.ndarray:
    """Computes distances [m] of all voxel centers to the nearest center of marked voxels, at most
    the diagonal of the grid."""
    if not voxels.any():
        return np.full(voxels.shape, _diagonal(voxels.shape, voxel_size), dtype=np.float32)
    return edt.edt(~voxels, anisotropy=(voxel_size,) * 3, parallel=1)


def occupancy_distances(occupied: np.ndarray, voxel_size: float) -> np.ndarray:
    """Computes signed distances to the faces of occupied voxels, never too large if interpolated.

    At voxel centers it is the exact distance [m], less the excess of the trilinear interpolant in
    the half voxels around: distances to an edge or corner are convex. Negative in occupied voxels.
    """
    if not occupied.any() or occupied.all():
        far = np.float32(_diagonal(occupied.shape, voxel_size))
        return np.full(occupied.shape, -far if occupied.any() else far)
    # In half voxels: sample 2i + 1 is the center of voxel i, 2i and 2i + 2 are its faces.
    distances = edt.edt(~_with_faces(occupied), parallel=1)
    distances -= edt.edt(~_with_faces(~occupied), parallel=1)
    near = np.empty(occupied.shape, np.float32)
    length = occupied.shape[0]
    for start in range(0, length, _SLAB):
        first, last = max(start - 1, 0), min(start + _SLAB + 1, length)
        part = distances[2 * first + 1 : 2 * last]
        part = part[:, 1:-1, 1:-1]  # from center to center along the other axes too
        excess = np.maximum(_between(part[::2, ::2, ::2]) - part, 0.0)
        excess = maximum_filter(excess, 3, mode="nearest")[::2, ::2, ::2]
        safe = part[::2, ::2, ::2] - excess
        end = min(start + _SLAB, length)
        near[start:end] = safe[start - first : end - first]
    return near * np.float32(0.5 * voxel_size)


def _with_faces(voxels: np.ndarray) -> np.ndarray:
    """Marks the samples, half a voxel apart, in or on marked voxels: (2nx + 1, ...) bool."""
    marked = np.zeros([2 * n + 1 for n in voxels.shape], bool)
    for corner in itertools.product(range(3), repeat=3):
        part = tuple(slice(i, i + 2 * n, 2) for i, n in zip(corner, voxels.shape, strict=True))
        marked[part] |= voxels
    return marked


def _between(values: np.ndarray) -> np.ndarray:
    """Inserts the means of neighbors into values (n, ...): (2n - 1, ...)."""
    for axis in range(values.ndim):
        values = np.moveaxis(values, axis, 0)
        finer = np.empty((2 * len(values) - 1, *values.shape[1:]), values.dtype)
        finer[::2] = values
        finer[1::2] = 0.5 * (values[:-1] + values[1:])
        values = np.moveaxis(finer, 0, axis)
    return values


def distances_from_band(occupied: np.ndarray, band: np.ndarray, voxel_size: float) -> np.ndarray:
    """Continues signed distances from a band of known values around the surface.

    Every voxel s of the band bounds the distance of a voxel x by |x - s| + |band(s)|, with the
    opposite sign of band(s) if s and x lie on different sides. The nearest s gives the first bound;
    passing the s of the six face neighbors along, twice, finds tighter ones. The band (nx, ny, nz)
    [m] is NaN where unknown; if it is empty, distances are the diagonal of the grid.
    """
    sites = np.isfinite(band)
    if not sites.any():
        far = np.float32(_diagonal(occupied.shape, voxel_size))
        return np.where(occupied, -far, far)
    nearest = distance_transform_edt(~sites, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)  # (3, nx, ny, nz) int32, for type checkers
    offset = band[tuple(nearest)] / np.float32(voxel_size)  # band(s), in voxels
    site = nearest.astype(np.float32)  # (3, nx, ny, nz), the index of s
    sign = np.where(occupied, np.float32(-1.0), np.float32(1.0))
    axes = (np.arange(n, dtype=np.float32) for n in occupied.shape)
    index = [
        np.broadcast_to(x, occupied.shape) for x in np.meshgrid(*axes, indexing="ij", sparse=True)
    ]

    def bound(where: tuple[slice, ...], site: np.ndarray, offset: np.ndarray) -> np.ndarray:
        x, y, z = (np.square(i[where] - s) for i, s in zip(index, site, strict=True))
        return np.sqrt(x + y + z) + sign[where] * offset

    best = bound((slice(None),) * 3, site, offset)
    for _, axis, step in itertools.product(range(2), range(3), (1, -1)):
        there, here = neighbor_slices(axis)[::step]
        # Copies: the neighbors' sites are read as they were before this pass.
        candidate, candidate_offset = site[:, *there].copy(), offset[there].copy()
        tighter = bound(here, candidate, candidate_offset)
        closer = tighter < best[here]
        np.copyto(best[here], tighter, where=closer)
        np.copyto(site[:, *here], candidate, where=closer)
        np.copyto(offset[here], candidate_offset, where=closer)
    return sign * best * np.float32(voxel_size)


def conservative_distances(
    distances: np.ndarray, states: np.ndarray, voxel_size: float
) -> np.ndarray:
    """Computes distances with unknown voxels and all outside the grid taken as occupied.

    In free voxels it is the distance [m] to the nearest occupied surface, face of an unknown voxel
    or face of the grid; in the others minus the distance to free space.
    """
    unknown = states == FieldState.UNKNOWN
    result = np.minimum(distances, _distance_to_faces(distances.shape, voxel_size))
    if not unknown.any():
        return result
    free = states == FieldState.FREE
    result = np.minimum(result, distance_to_voxels(unknown, voxel_size) - 0.5 * voxel_size)
    # Depth in occupied and unknown space together: otherwise a ridge would run along the back of a
    # wall that was seen from one side.
    band = np.where(free & (result < 2.0 * voxel_size), np.maximum(result, 0.0), np.nan)
    depth = distances_from_band(~free, band, voxel_size)
    return np.where(free, result, np.minimum(distances, depth))


def _distance_to_faces(shape: tuple[int, ...], voxel_size: float) -> np.ndarray:
    """Returns the distance of voxel centers to the nearest face of the grid, (nx, ny, nz) [m]."""
    x, y, z = (
        voxel_size * np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5).astype(np.float32)
        for n in shape
    )
    return np.minimum(np.minimum(x[:, None, None], y[:, None]), z)


def _diagonal(shape: tuple[int, ...], voxel_size: float) -> float:
    return voxel_size * float(np.linalg.norm(shape))
