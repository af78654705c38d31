"""A Euclidean signed distance field on a voxel grid: transforms, queries and storage."""

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import edt
import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter

from splatpilot import _native
from splatpilot.systems.collision.distance_field import (
    FieldSample,
    FieldState,
    linearize,
    sample_field,
)
from splatpilot.systems.common.drake import is_autodiff
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.state import array_namespace

FORMAT_VERSION = 1

# Name, number of dimensions and kinds of dtype of every entry of `esdf.npz`.
_ENTRIES = {
    "version": (0, "iu"),
    "distances": (3, "f"),
    "states": (3, "u"),
    "lower_W": (1, "f"),
    "voxel_size": (0, "f"),
    "occupied_outside": (0, "b"),
}


def interpolate_grid(
    grid: np.ndarray,
    lower_W: np.ndarray,
    voxel_size: float,
    p_WQ: np.ndarray,
    occupied_outside: bool = False,
    with_gradient: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates a grid (nx, ny, nz) float32 trilinearly, see `Esdf`.

    Returns values (...,) and their gradients (..., 3) [1/m], undefined without `with_gradient`.
    """
    points = np.ascontiguousarray(p_WQ, dtype=float).reshape(-1, 3)
    values, gradients = np.empty(len(points)), np.empty(points.shape)
    _native.grid_distances(
        grid=grid,
        lower_W=lower_W,
        upper_W=lower_W + voxel_size * np.array(grid.shape),
        voxel_size=voxel_size,
        occupied_outside=occupied_outside,
        p_WQ=points,
        distances=values,
        gradients=gradients if with_gradient else None,
    )
    return values.reshape(p_WQ.shape[:-1]), gradients.reshape(p_WQ.shape)


@dataclass(frozen=True, eq=False, repr=False)
class Esdf:
    """A signed distance field sampled at voxel centers and interpolated trilinearly; read-only.

    Values are extrapolated in the outermost half voxels. The gradient is the exact derivative of
    the interpolant. Points p_WQ (..., 3) [m] are numpy arrays or torch tensors; results are of the
    same type, and distances of tensors and of AutoDiffXd are differentiable.
    """

    distances: np.ndarray  # (nx, ny, nz) float32 [m]
    states: np.ndarray  # (nx, ny, nz) uint8 `FieldState`, of points in the voxel
    lower_W: np.ndarray  # (3,) float64 [m], lower corner of the box
    voxel_size: float  # [m] edge length of a voxel
    # All outside the box counts as occupied: there the distance is the value at the nearest point
    # of the box minus the distance to it. Otherwise it is NaN and its gradient zero.
    occupied_outside: bool = False
    upper_W: np.ndarray = field(init=False)  # (3,) float64 [m]

    def __post_init__(self) -> None:
        distances = np.ascontiguousarray(self.distances, dtype=np.float32).view()
        states = np.ascontiguousarray(self.states).view()
        lower_W = np.array(self.lower_W, dtype=float)
        voxel_size = float(self.voxel_size)
        shape = distances.shape
        valid = distances.ndim == 3 and min(shape) >= 2
        require(valid, "shape of distances", "(nx, ny, nz) with at least 2 voxels an axis", shape)
        valid = states.shape == shape and states.dtype == np.uint8
        found = f"{states.dtype} of {states.shape}"
        require(valid, "states", f"uint8 of the distances' shape {shape}", found)
        highest = states.max()
        require(highest <= FieldState.UNKNOWN, "states", "at most UNKNOWN (2)", highest)
        missing = np.count_nonzero(~np.isfinite(distances))
        require(not missing, "distances", "finite", f"{missing} of {distances.size} NaN or inf")
        require(0.0 < voxel_size < np.inf, "voxel_size", "in (0, inf) m", voxel_size)
        valid = lower_W.shape == (3,) and np.isfinite(lower_W).all()
        require(valid, "lower_W", "3 finite coordinates [m]", lower_W)
        upper_W = lower_W + voxel_size * np.array(shape)
        # A grid whose voxels vanish next to its coordinates is empty.
        valid = (upper_W - lower_W > voxel_size).all() and np.isfinite(upper_W).all()
        require(valid, "voxel_size", f"a distance that changes lower_W {lower_W} m", voxel_size)
        for array in (distances, states, lower_W, upper_W):
            array.flags.writeable = False
        # The class is frozen.
        vars(self).update(distances=distances, states=states, voxel_size=voxel_size)
        vars(self).update(lower_W=lower_W, upper_W=upper_W)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        nx, ny, nz = self.distances.shape
        return nx, ny, nz

    def volume(self, state: FieldState) -> float:
        """Returns the volume of the voxels of one state [m^3]."""
        return float(np.count_nonzero(self.states == state)) * self.voxel_size**3

    def voxel_centers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the coordinates of voxel centers along x (nx,), y (ny,) and z (nz,) [m]."""
        x, y, z = (
            lower + self.voxel_size * (np.arange(count) + 0.5)
            for lower, count in zip(self.lower_W, self.shape, strict=True)
        )
        return x, y, z

    def distance(self, p_WQ: Any) -> Any:
        """Returns signed distances (...,) [m] at the points, NaN outside the bounds."""
        if array_namespace(p_WQ) is not np or is_autodiff(p_WQ):
            return sample_field(self, p_WQ).distance
        box = self.lower_W, self.voxel_size
        points = _points(p_WQ)
        return interpolate_grid(self.distances, *box, points, self.occupied_outside, False)[0]

    def query(self, p_WQ: Any) -> FieldSample:
        """Returns distance, exact gradient of the interpolant and state at the points."""
        if (namespace := array_namespace(p_WQ)) is not np:
            sample = self.query(p_WQ.detach().cpu().numpy())
            distance, gradient = (p_WQ.new_tensor(array) for array in sample[:2])
            distance = linearize(distance, gradient, p_WQ - p_WQ.detach())
            state = namespace.as_tensor(sample.state, device=p_WQ.device)
            return FieldSample(distance, gradient, state)
        p_WQ, box = _points(p_WQ), (self.lower_W, self.voxel_size)
        distance, gradient = interpolate_grid(self.distances, *box, p_WQ, self.occupied_outside)
        inside = ((p_WQ >= self.lower_W) & (p_WQ <= self.upper_W)).all(axis=-1)
        voxel = np.floor((p_WQ - self.lower_W) / self.voxel_size)
        voxel = np.fmin(np.fmax(voxel, 0.0), np.array(self.shape) - 1.0).astype(np.intp)
        states = self.states[voxel[..., 0], voxel[..., 1], voxel[..., 2]]
        state = np.where(inside, states, np.uint8(FieldState.OUTSIDE))
        return FieldSample(distance, gradient, state)

    def conservative(self) -> "Esdf":
        """Returns the field a planner may trust: unknown space and all outside count as occupied.

        Occupied and unknown voxels hold minus the distance to free space, so that the gradient
        leads out of them. At corners where two surfaces meet the interpolant is up to 0.75 voxel
        too large, within half a voxel of the field's faces up to 1.25.
        """
        states, size = self.states, self.voxel_size
        to_faces = [np.minimum(i + 0.5, i[::-1] + 0.5) for i in map(np.arange, self.shape)]
        x, y, z = (size * steps.astype(np.float32) for steps in to_faces)
        distances = np.minimum(np.minimum(x[:, None, None], y[:, None]), z)
        distances = np.minimum(self.distances, distances)
        unknown = states == FieldState.UNKNOWN
        if unknown.any():
            free = states == FieldState.FREE
            distances = np.minimum(distances, distance_to_voxels(unknown, size) - 0.5 * size)
            # Depth in occupied and unknown space together: otherwise a ridge would run along the
            # back of a wall that was seen from one side.
            band = np.where(free & (distances < 2.0 * size), np.maximum(distances, 0.0), np.nan)
            depth = distances_from_band(~free, band, size)
            distances = np.where(free, distances, np.minimum(self.distances, depth))
        return Esdf(distances, states, self.lower_W, size, occupied_outside=True)

    def scaled_by(self, factor: float) -> "Esdf":
        """Returns the same field with all lengths from the origin times `factor`."""
        return Esdf(
            self.distances * np.float32(factor),
            self.states,
            factor * self.lower_W,
            factor * self.voxel_size,
            self.occupied_outside,
        )

    def save(self, path: str | Path) -> None:
        """Writes the field, by custom `esdf.npz`, atomically."""
        with written_atomically(path) as partial, partial.open("wb") as file:
            np.savez_compressed(
                file,
                version=np.int64(FORMAT_VERSION),
                distances=self.distances,
                states=self.states,
                lower_W=self.lower_W,
                voxel_size=np.float64(self.voxel_size),
                occupied_outside=np.bool_(self.occupied_outside),
            )

    @classmethod
    def load(cls, path: str | Path) -> "Esdf":
        """Reads a field that `save` wrote; raises ValueError for other or damaged files."""
        path = Path(path)
        archive = read_archive(path)
        for name, (ndim, kinds) in _ENTRIES.items():
            array = archive.get(name)
            valid = array is not None and array.ndim == ndim and array.dtype.kind in kinds
            kind = f"an array of {ndim} dimensions, of kind {' or '.join(kinds)}"
            found = "nothing" if array is None else f"{array.dtype} of {array.shape}"
            require(valid, f"{path}: {name}", kind, found)
        version, distances, states, lower_W, voxel_size, outside = (archive[n] for n in _ENTRIES)
        require(version == FORMAT_VERSION, f"{path}: version", str(FORMAT_VERSION), version)
        try:
            return cls(distances, states, lower_W, float(voxel_size), bool(outside))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _points(p_WQ: Any) -> np.ndarray:
    p_WQ = np.asarray(p_WQ, dtype=float)
    require(p_WQ.shape[-1:] == (3,), "shape of points", "(..., 3)", p_WQ.shape)
    return p_WQ


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
    """Computes signed distances [m] to the faces of occupied voxels, negative in these.

    They are exact at voxel centers, less the excess of the trilinear interpolant in the half voxels
    around: distances to an edge or corner are convex.
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
    """Continues signed distances from a band (nx, ny, nz) [m] around the surface, NaN elsewhere.

    Every voxel s of the band bounds the distance of a voxel x by |x - s| + |band(s)|, with the
    opposite sign of band(s) if s and x lie on different sides. The nearest s gives the first bound;
    passing the s of the six face neighbors along, twice, finds tighter ones. Without a band,
    distances are the diagonal of the grid.
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


def _diagonal(shape: tuple[int, ...], voxel_size: float) -> float:
    return voxel_size * float(np.linalg.norm(shape))
