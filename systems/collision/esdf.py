"""A Euclidean signed distance field on a voxel grid: queries and storage."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot import _native
from splatpilot.systems.collision.distance_field import (
    FieldSample,
    FieldState,
    linearize,
    sample_field,
)
from splatpilot.systems.collision.distance_transform import conservative_distances
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive
from splatpilot.systems.common.scalars import is_autodiff
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
    """A signed distance field sampled at voxel centers and interpolated trilinearly.

    Values are extrapolated in the outermost half voxels. The gradient is the exact derivative of
    the interpolant and jumps at the planes through voxel centers. The arrays are read-only.

    Points p_WQ (..., 3) [m] are numpy arrays or torch tensors; results are of the same type, and
    distances of tensors and of AutoDiffXd are differentiable.
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
        return self._interpolate(_points(p_WQ), with_gradient=False)[0]

    def query(self, p_WQ: Any) -> FieldSample:
        """Returns distance, exact gradient of the interpolant and state at the points."""
        if array_namespace(p_WQ) is not np:
            return self._query_tensor(p_WQ)
        p_WQ = _points(p_WQ)
        distance, gradient = self._interpolate(p_WQ)
        inside = ((p_WQ >= self.lower_W) & (p_WQ <= self.upper_W)).all(axis=-1)
        voxel = np.floor((p_WQ - self.lower_W) / self.voxel_size)
        voxel = np.fmin(np.fmax(voxel, 0.0), np.array(self.shape) - 1.0).astype(np.intp)
        states = self.states[voxel[..., 0], voxel[..., 1], voxel[..., 2]]
        state = np.where(inside, states, np.uint8(FieldState.OUTSIDE))
        return FieldSample(distance, gradient, state)

    def _interpolate(
        self, p_WQ: np.ndarray, with_gradient: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        box = self.lower_W, self.voxel_size
        return interpolate_grid(self.distances, *box, p_WQ, self.occupied_outside, with_gradient)

    def _query_tensor(self, p_WQ: Any) -> FieldSample:
        sample = self.query(p_WQ.detach().cpu().numpy())
        distance, gradient = (p_WQ.new_tensor(array) for array in sample[:2])
        distance = linearize(distance, gradient, p_WQ - p_WQ.detach())
        state = array_namespace(p_WQ).as_tensor(sample.state, device=p_WQ.device)
        return FieldSample(distance, gradient, state)

    def conservative(self) -> "Esdf":
        """Returns the field a planner may trust: unknown space and all outside count as occupied.

        Occupied and unknown voxels hold minus the distance to free space, so that the gradient
        leads out of them. At corners where two surfaces meet the interpolant is up to 0.75 voxel
        too large.
        """
        distances = conservative_distances(self.distances, self.states, self.voxel_size)
        return Esdf(distances, self.states, self.lower_W, self.voxel_size, occupied_outside=True)

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
        """Writes the field to `path`, by custom `esdf.npz`, atomically."""
        with written_atomically(Path(path)) as partial, partial.open("wb") as file:
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
