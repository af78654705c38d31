"""Builds an `Esdf` from occupancy, Gaussians or another distance field."""

import itertools
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_dilation

from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.collision.esdf import (
    Esdf,
    distances_from_band,
    neighbor_slices,
    occupancy_distances,
)
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import GaussianScene

MAX_VOXELS = 250_000_000  # of a field: its construction stays below about 8 GB

_SUPPORT = 3.5  # [standard deviations] beyond which a Gaussian counts as zero
_FILTER = 0.5  # [voxels] standard deviation of the filter that keeps thin Gaussians visible
_TRIM = 0.6  # [voxels] half the thickness left to a thin sheet; 0.5 is the least without holes
_CHUNK = 2_000_000  # evaluations of a Gaussian at a voxel per batch
# [voxels] to which extents are rounded up: 0 to 8, then rising by a quarter.
_SIZES = np.unique(np.r_[0:9, np.ceil(8 * 1.25 ** np.arange(60))].astype(int))


def grid_shape(lower_W: np.ndarray, upper_W: np.ndarray, voxel_size: float) -> tuple[int, int, int]:
    """Returns the numbers of voxels that cover the box [lower_W, upper_W], at least 2 an axis, and
    at most `MAX_VOXELS`."""
    extent = np.asarray(upper_W, dtype=float) - np.asarray(lower_W, dtype=float)
    valid = extent.shape == (3,) and np.isfinite(extent).all() and (extent > 0.0).all()
    require(valid, "upper_W", f"finite and above lower_W = {lower_W} m", upper_W)
    require(0.0 < voxel_size < np.inf, "voxel_size", "in (0, inf) m", voxel_size)
    # The slack keeps 36 m / 0.1 m at 360 voxels in spite of rounding.
    count = np.ceil(extent / voxel_size - 1e-6)
    box = f"a box of {extent} m with voxels of {voxel_size} m"
    require(count.min() >= 2, box, "at least 2 voxels along each axis", count)
    limit, total = f"at most {MAX_VOXELS:.3g} voxels", f"{count.prod():.3g}"
    remedy = "use larger voxels or a smaller box"
    require(count.prod() <= MAX_VOXELS, box, limit, total, remedy)
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
        surface_offset: (nx, ny, nz) [m], signed distance of a voxel's center from the surface, not
            positive in occupied voxels and not negative in others; NaN where it is unknown. Only
            values within one voxel are used. Without them the surface is the faces of voxels; see
            `occupancy_distances` if all are missing.
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


def esdf_from_gaussians(
    scene: GaussianScene, voxel_size: float, lower_W: np.ndarray, upper_W: np.ndarray
) -> Esdf:
    """Computes the distance field, in the box [lower_W, upper_W], of the solid where the Gaussians'
    density reaches 0.5.

    The density is sum_i o_i exp(-m_i^2 / 2) with m_i the Mahalanobis distance to Gaussian i, whose
    variances are enlarged by (voxel_size / 2)^2 so that thin sheets do not fall between voxels.
    Sheets are then trimmed to 0.6 voxel on both sides of their middle.
    """
    shape = grid_shape(lower_W, upper_W, voxel_size)
    density = density_on_grid(scene, np.asarray(lower_W, dtype=float), shape, voxel_size)
    offset = _surface_offset(density, voxel_size)
    occupied = offset <= 0.0
    # Farther out the slope may reach over the rim of the Gaussians' support.
    offset[~np.asarray(binary_dilation(occupied), dtype=bool)] = np.nan
    return esdf_from_occupancy(occupied, None, lower_W, voxel_size, offset)


def density_on_grid(
    scene: GaussianScene, lower_W: np.ndarray, shape: tuple[int, int, int], voxel_size: float
) -> np.ndarray:
    """Computes the Gaussians' density at the voxel centers, (nx, ny, nz) float32."""
    R = scene.rotations
    # In voxels from the first voxel's center from here on.
    variance = np.square(scene.scales / voxel_size, dtype=float) + _FILTER**2
    mean = (scene.means - lower_W) / voxel_size - 0.5
    reach = _SUPPORT * np.sqrt(np.einsum("nij,nj->ni", R**2, variance))
    first = np.maximum(np.ceil(mean - reach), 0.0)
    last = np.minimum(np.floor(mean + reach), np.array(shape) - 1.0)
    extent = np.where(first <= last, last - first + 1.0, 0.0).astype(int)  # (N, 3) voxels
    # Gaussians of the same extent are evaluated together on the same box of voxels.
    extent = _SIZES[np.searchsorted(_SIZES, extent)]
    # M maps a vector to the principal axes in standard deviations.
    M = R.transpose(0, 2, 1) / np.sqrt(variance)[:, :, None]
    density = np.zeros(np.prod(shape), dtype=np.float32)
    touching = np.flatnonzero(extent.all(axis=1))
    boxes, group = np.unique(extent[touching], axis=0, return_inverse=True)
    batches = []
    order = touching[np.argsort(group, kind="stable")]
    for box, same in zip(boxes, np.split(order, np.bincount(group)[:-1].cumsum()), strict=False):
        step = max(1, _CHUNK // box.prod())
        batches += [(box, same[start : start + step]) for start in range(0, len(same), step)]
    total = len(touching)
    with Progress(total=total, desc="density of Gaussians", unit="", delay=2.0) as progress:
        for box, n in batches:
            # M (first + voxel - mean): a constant for each Gaussian, and a product for all voxels.
            at_first = np.einsum("nij,nj->ni", M[n], first[n] - mean[n]).astype(np.float32)
            for start in range(0, box.prod(), _CHUNK):  # a box may be as large as the grid
                part = np.arange(start, min(start + _CHUNK, box.prod()))
                voxel = np.stack(np.unravel_index(part, box), -1)  # (V, 3)
                steps = M[n].astype(np.float32) @ voxel.T.astype(np.float32)  # (n, 3, V)
                squared = np.square(steps + at_first[:, :, None]).sum(axis=1)  # (n, V)
                value = scene.opacities[n, None] * np.exp(-0.5 * squared)
                index = first[n].astype(np.intp)[:, None, :] + voxel  # (n, V, 3)
                used = (squared < _SUPPORT**2) & (index < np.array(shape)).all(axis=-1)
                flat = np.ravel_multi_index(tuple(index[used].T), shape)
                np.add.at(density, flat, value[used])
            progress.update(len(n))
    return density.reshape(shape)


def _surface_offset(density: np.ndarray, voxel_size: float) -> np.ndarray:
    """Computes the signed distance of voxel centers to the surface to first order [m].

    With L = log(density / 0.5), the solid is the part of L >= 0 within _TRIM voxels of the
    middle of a sheet. The surface L = 0 is -L / |grad L| away. At x from the middle of a sheet of
    standard deviation s, enlarged to S^2 = s^2 + f^2 by the filter f, |grad L| is x / S^2; so
    f^2 |grad L| = x f^2 / S^2 is the distance to the middle of a thin sheet, and less in a thick
    one, which needs no trimming. NaN without density.
    """
    some = density > 0.0
    level = np.log(np.where(some, density, np.float32(1e-6)) / np.float32(0.5))
    slope = np.sqrt(sum(np.square(g) for g in np.gradient(level, np.float32(voxel_size))))
    with np.errstate(divide="ignore", invalid="ignore"):
        to_level = np.where(level == 0.0, np.float32(0.0), -level / slope)
    to_middle = np.float32(_FILTER * voxel_size) ** 2 * slope
    offset = np.maximum(to_level, to_middle - np.float32(_TRIM * voxel_size))
    return np.where(some, offset, np.float32(np.nan))


def esdf_from_distance_field(field: DistanceField, voxel_size: float) -> Esdf:
    """Samples a distance field at the voxel centers of a grid over its bounds; centers beyond them
    take the nearest value inside."""
    lower_W, upper_W = np.asarray(field.lower_W, float), np.asarray(field.upper_W, float)
    shape = grid_shape(lower_W, upper_W, voxel_size)
    distances = np.empty(shape, dtype=np.float32)
    states = np.empty(shape, dtype=np.uint8)
    x, y, z = (
        np.minimum(lower + voxel_size * (np.arange(n) + 0.5), upper)
        for lower, upper, n in zip(lower_W, upper_W, shape, strict=True)
    )
    for part, p_WQ in cubes_of_points(x, y, z):
        sample = field.query(p_WQ)
        distances[part], states[part] = sample.distance, sample.state
    return Esdf(distances, states, lower_W, voxel_size)


def cubes_of_points(
    x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> Iterator[tuple[tuple[slice, slice, slice], np.ndarray]]:
    """Yields slices and points (n, n, n, 3) of a grid in cubes of 16 points a side: fields find the
    nearest of many shapes faster for points that lie close together."""
    for i, j, k in itertools.product(*(range(0, len(axis), 16) for axis in (x, y, z))):
        part = np.s_[i : i + 16, j : j + 16, k : k + 16]
        axes = np.meshgrid(x[part[0]], y[part[1]], z[part[2]], indexing="ij")
        yield part, np.stack(axes, axis=-1)
