"""The frontier of a distance field, where observed free space ends in unobserved space."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.ndimage import binary_dilation, label, maximum_filter

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import (
    Esdf,
    distance_to_voxels,
    neighbor_slices,
    occupancy_distances,
)
from splatpilot.systems.splats.background import FAR


def reachable_space(esdf: Esdf, radius: float) -> NDArray[np.bool_]:
    """Returns the free voxels (nx, ny, nz) connected by faces to one in which a sphere of `radius`
    [m] fits: its camera looks through these only."""
    free = esdf.states == FieldState.FREE
    parts = np.asarray(label(free)[0], dtype=np.intp)  # pyright: ignore[reportIndexIssue]
    clearance = distance_to_voxels(~free, esdf.voxel_size) - 0.5 * esdf.voxel_size
    return np.isin(parts, np.unique(parts[free & (clearance > radius)]))


def frontier_faces(
    before: NDArray[np.bool_], hidden: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns centers (F, 3) [voxels] and unit normals (F, 3), out of hidden space, of the faces
    between voxels `before` the frontier (nx, ny, nz) and `hidden` ones."""
    centers, normals = [], []
    for axis in range(3):
        normal = np.where(np.arange(3) == axis, 1.0, 0.0)
        lower, upper = neighbor_slices(axis)
        for sign, (low, high) in ((-1.0, (before, hidden)), (1.0, (hidden, before))):
            index = np.argwhere(low[lower] & high[upper])
            centers.append(index + 0.5 + 0.5 * normal)
            normals.append(np.tile(sign * normal, (len(index), 1)))
    return np.concatenate(centers), np.concatenate(normals)


def hidden_frontier(
    esdf: Esdf,
    reachable: NDArray[np.bool_],
    depths: Iterable[np.ndarray],
    K: np.ndarray,
    X_WCs: Sequence[RigidTransform],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], bool]:
    """Finds the unknown space at the edge of `reachable` voxels (nx, ny, nz) that no image crossed.

    It begins two voxels behind the last one seen free, where an obstacle hides nothing captured.
    Before the sky, and before surfaces beyond the field's range, space is unknown only because it
    is far away: an obstacle there would hide them.

    Returns the first hidden voxels (nx, ny, nz), the voxels (nx, ny, nz) before them, and True if
    the frontier was left open before a surface.
    """
    unknown = esdf.states == FieldState.UNKNOWN
    before = _dilated(reachable) & (esdf.states != FieldState.OCCUPIED)
    first = binary_dilation(before) & unknown & ~_dilated(esdf.states == FieldState.FREE)
    index = np.argwhere(_dilated(first) & unknown)
    p_WV = esdf.lower_W + esdf.voxel_size * (index + 0.5)
    deepest = np.zeros(len(index))  # [m] seen through each voxel
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        z = (p_WV - X_WC.translation()) @ X_WC.rotation().matrix()[:, 2]
        seen = _pixel_values(p_WV, depth, K, X_WC)
        deepest = np.fmax(deepest, np.where(seen > z + esdf.voxel_size, seen, 0.0))
    open_ = np.zeros_like(first)
    open_[tuple(index[deepest > 0.0].T)] = True
    before_surface = bool(((deepest > 0.0) & (deepest < FAR)).any())
    return first & ~_dilated(open_), before, before_surface


def _pixel_values(
    p_WQ: np.ndarray, image: np.ndarray, K: np.ndarray, X_WC: RigidTransform
) -> NDArray[np.float64]:
    """Returns the pixels (N,) of an image (H, W) that see points (N, 3) [m]; NaN beyond its inside.

    At the border rounding would decide.
    """
    p_CQ = (p_WQ - X_WC.translation()) @ X_WC.rotation().matrix()
    ahead = np.flatnonzero(p_CQ[:, 2] > 0.0)
    x, y, _ = (p_CQ[ahead] / p_CQ[ahead, 2:]).T
    column, row = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
    height, width = image.shape
    inside = (column >= 1.0) & (column < width - 1) & (row >= 1.0) & (row < height - 1)
    values = np.full(len(p_WQ), np.nan)
    values[ahead[inside]] = image[row[inside].astype(int), column[inside].astype(int)]
    return values


def _dilated(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Adds all voxels that share a corner."""
    return np.asarray(maximum_filter(voxels, size=3), dtype=bool)


def with_obstacles(esdf: Esdf, voxels: NDArray[np.bool_]) -> Esdf:
    """Returns the field in which `voxels` (nx, ny, nz) are occupied too."""
    return Esdf(
        np.minimum(esdf.distances, occupancy_distances(voxels, esdf.voxel_size)),
        np.where(voxels, np.uint8(FieldState.OCCUPIED), esdf.states),
        esdf.lower_W,
        esdf.voxel_size,
        esdf.occupied_outside,
    )
