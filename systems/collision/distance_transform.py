"""Exact Euclidean distance transforms of voxel grids, with surfaces placed within the voxels."""

import itertools

import edt
import numpy as np
from scipy.ndimage import distance_transform_edt

from splatpilot.systems.collision.distance_field import FieldState


def distance_to_voxels(voxels: np.ndarray, voxel_size: float) -> np.ndarray:
    """Distance from every voxel's centre to the nearest centre of the marked voxels.

    Args:
        voxels: (nx, ny, nz) bool.
        voxel_size: [m].

    Returns:
        (nx, ny, nz) float32 [m], zero at the marked voxels; where none is marked, the diagonal of
        the grid, which is more than any distance in it.
    """
    if not voxels.any():
        return np.full(voxels.shape, _diagonal(voxels.shape, voxel_size), dtype=np.float32)
    return edt.edt(~voxels, anisotropy=(voxel_size,) * 3, parallel=1)


def occupancy_distances(occupied: np.ndarray, voxel_size: float) -> np.ndarray:
    """Signed distance to occupied voxels whose surface is the faces of the voxels.

    The two-sided transform between voxel centres less half a voxel. Outside smooth solids sampled
    at voxel centres it is biased near, the safe side, by up to 0.35 voxel (rms 0.2 to 0.4), because
    a face is met obliquely; the transform without that half voxel is biased far by 0.2 to 0.5.

    Args:
        occupied: (nx, ny, nz) bool.
        voxel_size: [m].

    Returns:
        (nx, ny, nz) float32 [m], negative in occupied voxels.
    """
    outside = distance_to_voxels(occupied, voxel_size) - 0.5 * voxel_size
    inside = distance_to_voxels(~occupied, voxel_size) - 0.5 * voxel_size
    return np.where(occupied, -inside, outside)


def distances_from_band(
    occupied: np.ndarray, band: np.ndarray, voxel_size: float, sweeps: int = 2
) -> np.ndarray:
    """Signed distance continued from a band of known values around the surface.

    A distance field cannot grow faster than the distance travelled, so every voxel s of the band
    bounds that of a voxel x by |x - s| + |band(s)|, with the sign of band(s) turned where s and x
    lie on different sides. The nearest s (by the exact transform) gives the first bound; passing
    the s of the six face neighbours along, `sweeps` times, finds others that bound x tighter.

    Args:
        occupied: (nx, ny, nz) bool.
        band: (nx, ny, nz) float32 [m], signed distance to the surface where it is known, NaN
            elsewhere; not positive in occupied voxels and not negative in the others.
        voxel_size: [m].
        sweeps: rounds of passing sites to neighbours.

    Returns:
        (nx, ny, nz) float32 [m]; plus or minus the diagonal of the grid when the band is empty.
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
    index = np.ogrid[tuple(slice(0, n) for n in occupied.shape)]
    index = [axis.astype(np.float32) for axis in index]

    def bound(where: tuple[slice, ...], site: np.ndarray, offset: np.ndarray) -> np.ndarray:
        squared = np.float32(0.0)
        for axis in range(3):
            x = index[axis][tuple(w if a == axis else slice(None) for a, w in enumerate(where))]
            squared = squared + np.square(x - site[axis])
        return np.sqrt(squared) + sign[where] * offset

    best = bound((slice(None),) * 3, site, offset)
    for _ in range(sweeps):
        for axis, step in itertools.product(range(3), (1, -1)):
            ahead = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
            behind = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
            here, there = (ahead, behind) if step == 1 else (behind, ahead)
            # Copies: the neighbours' sites are read as they were before this pass.
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
    """Distances with unknown voxels and everything outside the grid taken as occupied.

    Args:
        distances: (nx, ny, nz) float32 [m], signed, to the occupied surfaces.
        states: (nx, ny, nz) uint8 `FieldState`.
        voxel_size: [m].

    Returns:
        (nx, ny, nz) float32 [m]: in free voxels the smallest of the distance to an occupied
        surface, to the faces of unknown voxels and to the faces of the grid; in the others minus
        the distance to free space.
    """
    unknown = states == FieldState.UNKNOWN
    result = np.minimum(distances, _distance_to_faces(distances.shape, voxel_size))
    if not unknown.any():
        return result
    free = states == FieldState.FREE
    result = np.minimum(result, distance_to_voxels(unknown, voxel_size) - 0.5 * voxel_size)
    # A wall seen from one side has free space before it and unknown space behind it: depth in the
    # two together is measured to free space, or a ridge would run along the back of the wall.
    band = np.where(free & (result < 2.0 * voxel_size), np.maximum(result, 0.0), np.nan)
    depth = distances_from_band(~free, band, voxel_size)
    return np.where(free, result, np.minimum(distances, depth))


def _distance_to_faces(shape: tuple[int, ...], voxel_size: float) -> np.ndarray:
    """Distance of the voxel centres to the nearest face of the grid, (nx, ny, nz) float32 [m]."""
    x, y, z = (
        voxel_size * np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5).astype(np.float32)
        for n in shape
    )
    return np.minimum(np.minimum(x[:, None, None], y[:, None]), z)


def _diagonal(shape: tuple[int, ...], voxel_size: float) -> float:
    return voxel_size * float(np.linalg.norm(shape))
