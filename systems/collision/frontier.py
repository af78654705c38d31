"""The frontier of a distance field: where seen, free space ends in space nobody looked into."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.ndimage import binary_dilation, label, maximum_filter

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.distance_transform import distance_to_voxels, occupancy_distances
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.background import FAR


def reachable_space(esdf: Esdf, radius: float) -> NDArray[np.bool_]:
    """The free voxels (nx, ny, nz) that are connected, by faces, to one in which a sphere of
    `radius` [m] fits: whatever is seen from where the sphere can be, is seen through them."""
    free = esdf.states == FieldState.FREE
    parts = np.asarray(label(free)[0], dtype=np.intp)  # pyright: ignore[reportIndexIssue]
    room = distance_to_voxels(~free, esdf.voxel_size) - 0.5 * esdf.voxel_size
    roomy = np.unique(parts[free & (room > radius)])
    return np.isin(parts, roomy)


def frontier_faces(
    before: NDArray[np.bool_], hidden: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The faces that voxels `before` the frontier (nx, ny, nz) share with those `hidden` behind it.

    Returns:
        Their centers (F, 3) in voxels from the lower corner of the grid, and their unit normals
        (F, 3), out of what is hidden.
    """
    centers, normals = [], []
    for axis in range(3):
        normal = np.where(np.arange(3) == axis, 1.0, 0.0)
        lower = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        upper = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
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
    """Finds the unknown space at the edge of the voxels `reachable` (nx, ny, nz), but for space
    that an image saw through.

    It begins two voxels behind the last one that was seen to be free: an obstacle there hides
    nothing of what the images saw. Before the sky, and before surfaces beyond the field's range,
    space is unknown only because it is far away: an obstacle there would hide them.

    Args:
        depths, K, X_WCs: what the field was made of, see `esdf_from_depth_images`.

    Returns:
        The first of its voxels (nx, ny, nz), the voxels (nx, ny, nz) before them, and whether it
        was left open before a surface.
    """
    unknown = esdf.states == FieldState.UNKNOWN
    before = _grown(reachable) & (esdf.states != FieldState.OCCUPIED)
    first = binary_dilation(before) & unknown & ~_grown(esdf.states == FieldState.FREE)
    index = np.argwhere(_grown(first) & unknown)
    p_WV = esdf.lower_W + esdf.voxel_size * (index + 0.5)
    deepest = np.zeros(len(index))  # [m] of what is seen through each voxel
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        z = (p_WV - X_WC.translation()) @ X_WC.rotation().matrix()[:, 2]
        seen = _values_at(p_WV, depth, K, X_WC)
        deepest = np.fmax(deepest, np.where(seen > z + esdf.voxel_size, seen, 0.0))
    open_ = np.zeros_like(first)
    open_[tuple(index[deepest > 0.0].T)] = True
    before_surface = bool(((deepest > 0.0) & (deepest < FAR)).any())
    return first & ~_grown(open_), before, before_surface


def _values_at(
    p_WQ: np.ndarray, image: np.ndarray, K: np.ndarray, X_WC: RigidTransform
) -> NDArray[np.float64]:
    """Returns the pixels (N,) of an image (H, W) that see the points (N, 3) [m]; NaN beside it and
    at its border, where rounding decides."""
    p_CQ = (p_WQ - X_WC.translation()) @ X_WC.rotation().matrix()
    ahead = np.flatnonzero(p_CQ[:, 2] > 0.0)
    x, y, _ = (p_CQ[ahead] / p_CQ[ahead, 2:]).T
    column, row = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
    height, width = image.shape
    inside = (column >= 1.0) & (column < width - 1) & (row >= 1.0) & (row < height - 1)
    values = np.full(len(p_WQ), np.nan)
    values[ahead[inside]] = image[row[inside].astype(int), column[inside].astype(int)]
    return values


def _grown(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels (nx, ny, nz) and all that touch them, by a corner at least."""
    return np.asarray(maximum_filter(voxels, size=3), dtype=bool)


def with_obstacles(esdf: Esdf, voxels: NDArray[np.bool_]) -> Esdf:
    """The field in which the `voxels` (nx, ny, nz) are occupied too, their faces its surfaces."""
    return Esdf(
        np.minimum(esdf.distances, occupancy_distances(voxels, esdf.voxel_size)),
        np.where(voxels, np.uint8(FieldState.OCCUPIED), esdf.states),
        esdf.lower_W,
        esdf.voxel_size,
        esdf.occupied_outside,
    )
