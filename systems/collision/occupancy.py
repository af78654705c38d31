"""Distance fields from occupancy grids."""

import numpy as np

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.distance_transform import (
    distances_from_band,
    neighbor_slices,
    occupancy_distances,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.validation import require

MAX_VOXELS = 250_000_000
"""Of a field: its arrays and those of its construction stay below about 8 GB."""


def grid_shape(lower_W: np.ndarray, upper_W: np.ndarray, voxel_size: float) -> tuple[int, int, int]:
    """Returns the number of voxels along each axis that cover the box [lower_W, upper_W].

    The last may reach beyond it. Grids have at least 2 voxels an axis and at most `MAX_VOXELS`.
    """
    extent = np.asarray(upper_W, dtype=float) - np.asarray(lower_W, dtype=float)
    valid = extent.shape == (3,) and np.isfinite(extent).all() and (extent > 0.0).all()
    require(valid, "upper_W", f"finite and above lower_W = {lower_W} m", upper_W)
    require(0.0 < voxel_size < np.inf, "voxel_size", "in (0, inf) m", voxel_size)
    # The slack keeps 36 m / 0.1 m at 360 voxels in spite of rounding.
    count = np.ceil(extent / voxel_size - 1e-6)
    box = f"a box of {extent} m with voxels of {voxel_size} m"
    require(count.min() >= 2, box, "at least 2 voxels along each axis", count)
    limit = f"at most {MAX_VOXELS:.3g} voxels"
    require(count.prod() <= MAX_VOXELS, box, limit, f"{count.prod():.3g}", "use larger voxels")
    nx, ny, nz = count.astype(int)
    return int(nx), int(ny), int(nz)


def esdf_from_occupancy(
    occupied: np.ndarray,
    unknown: np.ndarray | None,
    lower_W: np.ndarray,
    voxel_size: float,
    surface_offset: np.ndarray | None = None,
) -> Esdf:
    """Computes the signed distance field of an occupancy grid.

    Args:
        occupied: (nx, ny, nz) bool.
        unknown: (nx, ny, nz) bool, voxels never observed, none of them occupied; None for none.
        lower_W: (3,) [m], lower corner of the grid.
        voxel_size: [m].
        surface_offset: (nx, ny, nz) [m], signed distance of a voxel's center from the surface, not
            positive in occupied voxels and not negative in others; NaN where it is unknown. Values
            beyond one voxel are not used. Without values on either side the surface is the faces of
            its voxels; if all are missing, distances are never too large, see
            `occupancy_distances`.
    """
    occupied = np.asarray(occupied, dtype=bool)
    unknown = np.zeros_like(occupied) if unknown is None else np.asarray(unknown, dtype=bool)
    valid = unknown.shape == occupied.shape
    require(valid, "shape of unknown", f"that of occupied, {occupied.shape}", unknown.shape)
    both = np.count_nonzero(occupied & unknown)
    require(not both, "number of voxels both occupied and unknown", "0", both)
    if surface_offset is None:
        distances = occupancy_distances(occupied, voxel_size)
    else:
        band = _band(occupied, np.asarray(surface_offset, dtype=np.float32), voxel_size)
        distances = distances_from_band(occupied, band, voxel_size)
    states = occupied.astype(np.uint8) * np.uint8(FieldState.OCCUPIED)
    states[unknown] = FieldState.UNKNOWN
    return Esdf(distances, states, lower_W, voxel_size)


def _band(occupied: np.ndarray, offset: np.ndarray, voxel_size: float) -> np.ndarray:
    """Returns the known signed distances within one voxel of the surface, NaN elsewhere."""
    valid = offset.shape == occupied.shape
    require(valid, "shape of surface_offset", f"that of occupied, {occupied.shape}", offset.shape)
    wrong = np.count_nonzero(np.where(occupied, offset > 0.0, offset < 0.0))
    condition = "<= 0 in occupied voxels and >= 0 in others"
    require(not wrong, "surface_offset", condition, f"{wrong} voxels of the wrong sign")
    with np.errstate(invalid="ignore"):
        band = np.where(np.abs(offset) < voxel_size, offset, np.float32(np.nan))
    # A face between occupied and other voxels where neither side knows its offset.
    known = np.isfinite(band)
    half = np.float32(0.5 * voxel_size)
    for axis in range(3):
        a, b = neighbor_slices(axis)
        bare = (occupied[a] != occupied[b]) & ~known[a] & ~known[b]
        for side in (a, b):
            np.copyto(band[side], np.where(occupied[side], -half, half), where=bare)
    return band
