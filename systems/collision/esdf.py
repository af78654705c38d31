"""A Euclidean signed distance field on a voxel grid: queries and storage."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from splatpilot import _native
from splatpilot.systems.collision.distance_field import FieldSample, FieldState
from splatpilot.systems.collision.distance_transform import conservative_distances
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive

FORMAT_VERSION = 1

# Name, number of dimensions and kinds of dtype of every entry.
_ENTRIES = {
    "version": (0, "iu"),
    "distances": (3, "f"),
    "states": (3, "u"),
    "lower_W": (1, "f"),
    "voxel_size": (0, "f"),
    "occupied_outside": (0, "b"),
}


def write_esdf_arrays(
    path: str | Path,
    *,
    distances: np.ndarray,
    states: np.ndarray,
    lower_W: np.ndarray,
    voxel_size: float,
    occupied_outside: bool,
) -> None:
    """Write the arrays of an `Esdf`; a temporary file beside `path` is renamed at the end.

    Raises:
        OSError: if the folder is missing or not writable.
    """
    with written_atomically(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            version=np.int64(FORMAT_VERSION),
            distances=distances,
            states=states,
            lower_W=lower_W,
            voxel_size=np.float64(voxel_size),
            occupied_outside=np.bool_(occupied_outside),
        )


def read_esdf_arrays(path: str | Path) -> dict[str, Any]:
    """The constructor arguments of an `Esdf` from a file that `write_esdf_arrays` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no numpy archive, is damaged, lacks an entry, holds one of another type
            or was written by a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such distance field file (esdf.npz).")
    archive = read_archive(path)
    arrays = {name: archive[name] for name in _ENTRIES if name in archive}
    missing = [name for name in _ENTRIES if name not in arrays]
    if missing:
        raise ValueError(
            f"{path}: not a distance field; the entries {missing} are missing. Write one with "
            "Esdf.save."
        )
    for name, (ndim, kinds) in _ENTRIES.items():
        array = arrays[name]
        if array.ndim != ndim or array.dtype.kind not in kinds:
            raise ValueError(
                f"{path}: the entry {name!r} is {array.dtype} of shape {array.shape}; needed is an "
                f"array of {ndim} dimensions and a dtype of kind {' or '.join(kinds)}."
            )
    version = int(arrays.pop("version"))
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{path}: distance field format {version}; this program reads format "
            f"{FORMAT_VERSION}. Build the field anew."
        )
    return {
        **arrays,
        "voxel_size": float(arrays["voxel_size"]),
        "occupied_outside": bool(arrays["occupied_outside"]),
    }


def grid_strides(shape: tuple[int, ...]) -> np.ndarray:
    """Distance, in elements, between neighbours along x, y and z of a C-ordered grid; (3,) int."""
    return np.array([shape[1] * shape[2], shape[2], 1], dtype=np.intp)


def corner_offsets(shape: tuple[int, ...]) -> np.ndarray:
    """Flat-index offsets of the eight corners of a cell from its lowest one; (2, 2, 2, 1) int."""
    sx, sy, sz = grid_strides(shape)
    step = np.arange(2)
    return (
        step[:, None, None, None] * sx + step[:, None, None] * sy + step[:, None] * sz
    )  # (2, 2, 2, 1)


def trilinear(corners: Any, fx: Any, fy: Any, fz: Any) -> Any:
    """The interpolant of eight corner values at the fractions (fx, fy, fz) of the cell.

    Fractions outside [0, 1] extrapolate the cell's polynomial.

    Args:
        corners: (2, 2, 2, N), indexed by the corner's x, y and z.
        fx, fy, fz: (N,) each.

    Returns:
        (N,) values.
    """
    along_yz = corners[0] + fx * (corners[1] - corners[0])  # (2, 2, N)
    along_z = along_yz[0] + fy * (along_yz[1] - along_yz[0])  # (2, N)
    return along_z[0] + fz * (along_z[1] - along_z[0])


def trilinear_with_gradient(corners: Any, fx: Any, fy: Any, fz: Any) -> tuple[Any, Any, Any, Any]:
    """`trilinear` with its exact partial derivatives by fx, fy and fz.

    Returns:
        value, d/dfx, d/dfy, d/dfz: (N,) each.
    """
    slope_x = corners[1] - corners[0]  # (2, 2, N)
    along_yz = corners[0] + fx * slope_x
    slope_y = along_yz[1] - along_yz[0]  # (2, N)
    along_z = along_yz[0] + fy * slope_y
    slope_z = along_z[1] - along_z[0]  # (N,)
    slope_x = slope_x[0] + fy * (slope_x[1] - slope_x[0])  # (2, N)
    return (
        along_z[0] + fz * slope_z,
        slope_x[0] + fz * (slope_x[1] - slope_x[0]),
        slope_y[0] + fz * (slope_y[1] - slope_y[0]),
        slope_z,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Esdf:
    """A signed distance field sampled at voxel centres and interpolated trilinearly.

    Voxel (i, j, k) covers lower_W + [i, i+1] x [j, j+1] x [k, k+1] * voxel_size and its value
    stands at its centre. The field is continuous; its gradient is the exact derivative of the
    interpolant and jumps at the planes through voxel centres. In the outermost half voxel the
    interpolant is extrapolated. The arrays are read-only, so a field is shared by reference.

    Raises:
        ValueError: for arrays of the wrong shape, values that are not finite, states that are no
            `FieldState` of a voxel or a voxel size that is not positive.
    """

    distances: np.ndarray  # (nx, ny, nz) float32 [m], at least two voxels an axis, all finite
    # (nx, ny, nz) uint8, `FieldState` FREE, OCCUPIED or UNKNOWN; the state of a point is that of
    # the voxel it lies in.
    states: np.ndarray
    lower_W: np.ndarray  # (3,) float64 [m] lower corner of the box, the corner of a voxel
    voxel_size: float  # [m] edge length of a voxel
    # Whether the field goes on outside the box, all of which then counts as occupied: the value at
    # the nearest point of the box minus the distance to it. Otherwise the distance outside is NaN
    # and its gradient zero.
    occupied_outside: bool = False
    upper_W: np.ndarray = field(init=False)  # (3,) float64 [m]
    # What every query needs, prepared once.
    _first_center_W: np.ndarray = field(init=False)  # (3, 1) [m]
    _last_cell: np.ndarray = field(init=False)  # (3, 1)
    _strides: np.ndarray = field(init=False)  # (3,)
    _corner_offsets: np.ndarray = field(init=False)  # (2, 2, 2, 1)

    def __post_init__(self) -> None:
        distances = np.ascontiguousarray(self.distances, dtype=np.float32).view()
        states = np.ascontiguousarray(self.states).view()
        lower_W = np.array(self.lower_W, dtype=float)
        voxel_size = float(self.voxel_size)
        if distances.ndim != 3 or min(distances.shape) < 2:
            raise ValueError(
                f"Esdf: distances have shape {distances.shape}; needed is (nx, ny, nz) with at "
                "least 2 voxels along each axis."
            )
        if states.shape != distances.shape or states.dtype != np.uint8:
            raise ValueError(
                f"Esdf: states are {states.dtype} of shape {states.shape}; needed is uint8 of the "
                f"distances' shape {distances.shape}."
            )
        if states.max() > FieldState.UNKNOWN:
            raise ValueError(
                f"Esdf: states hold the value {states.max()}; a voxel is FREE (0), OCCUPIED (1) or "
                "UNKNOWN (2)."
            )
        if not np.isfinite(distances).all():
            raise ValueError(
                f"Esdf: {np.count_nonzero(~np.isfinite(distances))} of {distances.size} distances "
                "are NaN or infinite; a grid stores finite distances and marks what it does not "
                "know in its states."
            )
        if not (np.isfinite(voxel_size) and voxel_size > 0.0):
            raise ValueError(f"Esdf: the voxel size is {voxel_size} m; it must be positive.")
        if lower_W.shape != (3,) or not np.isfinite(lower_W).all():
            raise ValueError(f"Esdf: lower_W is {lower_W}; needed are 3 finite coordinates [m].")
        upper_W = lower_W + voxel_size * np.array(distances.shape)
        # A grid whose voxels vanish beside its coordinates has no inside.
        if not (upper_W - lower_W > voxel_size).all() or not np.isfinite(upper_W).all():
            raise ValueError(
                f"Esdf: voxels of {voxel_size} m at {lower_W} m make no box; the numbers cannot "
                "tell its ends apart."
            )
        for array in (distances, states, lower_W, upper_W):
            array.flags.writeable = False
        set_field = object.__setattr__  # The class is frozen; these are its construction.
        set_field(self, "distances", distances)
        set_field(self, "states", states)
        set_field(self, "lower_W", lower_W)
        set_field(self, "voxel_size", voxel_size)
        set_field(self, "upper_W", upper_W)
        set_field(self, "_first_center_W", (lower_W + 0.5 * voxel_size)[:, None])
        set_field(self, "_last_cell", np.array(distances.shape, dtype=float)[:, None] - 2.0)
        set_field(self, "_strides", grid_strides(distances.shape))
        set_field(self, "_corner_offsets", corner_offsets(distances.shape))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        nx, ny, nz = self.distances.shape
        return nx, ny, nz

    def volume(self, state: FieldState) -> float:
        """The volume of the voxels of one state [m^3]."""
        return float(np.count_nonzero(self.states == state)) * self.voxel_size**3

    def voxel_centers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The coordinates of the voxel centres along x (nx,), y (ny,) and z (nz,) [m]."""
        x, y, z = (
            lower + self.voxel_size * (np.arange(count) + 0.5)
            for lower, count in zip(self.lower_W, self.shape, strict=True)
        )
        return x, y, z

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Signed distance at the points p_WQ (..., 3) [m]: (...,) [m], NaN outside the bounds.

        A point that is not finite is outside.
        """
        p_WQ = _points(p_WQ)
        distances = np.empty(p_WQ.shape[:-1])
        _native.grid_distances(
            grid=self.distances,
            lower_W=self.lower_W,
            upper_W=self.upper_W,
            voxel_size=self.voxel_size,
            occupied_outside=self.occupied_outside,
            p_WQ=np.ascontiguousarray(p_WQ).reshape(-1, 3),
            distances=distances.reshape(-1),
        )
        return distances

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Distance, exact gradient of the interpolant and state at the points p_WQ (..., 3) [m]."""
        p_WQ = _points(p_WQ)
        p, p_box, inside = self._split(p_WQ)
        corners, fractions, cell = self._cell(p_box)
        value, *slopes = trilinear_with_gradient(corners, *fractions)
        gradient = np.array(slopes) / self.voxel_size  # (3, N)
        nearest = self._strides @ (cell + (fractions >= 0.5)).astype(np.intp)
        state = self.states.take(nearest)
        if inside is not None:
            beyond = p - p_box  # (3, N)
            value = self._extend(value, p, p_box, inside)
            if self.occupied_outside:
                with np.errstate(invalid="ignore"):
                    outward = beyond / np.linalg.norm(beyond, axis=0)
                gradient = np.where(
                    inside, gradient, np.where(beyond == 0.0, gradient, 0.0) - outward
                )
            else:
                gradient = np.where(inside, gradient, 0.0)
            state = np.where(inside, state, np.uint8(FieldState.OUTSIDE))
        shape = p_WQ.shape[:-1]
        return FieldSample(
            value.reshape(shape), gradient.T.reshape(p_WQ.shape), state.reshape(shape)
        )

    def conservative(self) -> "Esdf":
        """The field a planner may trust: unknown space and all outside the box count as occupied.

        Free voxels hold the distance to the nearest of: an occupied surface, an unknown voxel, the
        faces of the box. Occupied and unknown voxels hold minus the distance to free space, so that
        the gradient leads out of them. Outside the box the field goes on, see `occupied_outside`:
        there it is at most minus the true distance to free space, and 1-Lipschitz wherever the
        box's boundary is free (elsewhere up to sqrt 2). The interpolant cuts the corners where two
        of the surfaces meet: there, worst at the corners of the box, the field is up to 0.75 voxel
        too large. The states are kept.
        """
        distances = conservative_distances(self.distances, self.states, self.voxel_size)
        return Esdf(distances, self.states, self.lower_W, self.voxel_size, occupied_outside=True)

    def scaled_by(self, factor: float) -> "Esdf":
        """The field of the same place with all lengths from the origin times `factor`."""
        return Esdf(
            self.distances * np.float32(factor),
            self.states,
            factor * self.lower_W,
            factor * self.voxel_size,
            self.occupied_outside,
        )

    def save(self, path: str | Path) -> None:
        """Writes the field to `path` (by custom `esdf.npz`), whole or not at all."""
        write_esdf_arrays(
            path,
            distances=self.distances,
            states=self.states,
            lower_W=self.lower_W,
            voxel_size=self.voxel_size,
            occupied_outside=self.occupied_outside,
        )

    @classmethod
    def load(cls, path: str | Path) -> "Esdf":
        """Reads a field that `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is no distance field, or a damaged one; the message names it.
        """
        arrays = read_esdf_arrays(path)
        try:
            return cls(**arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def _split(self, p_WQ: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Points (..., 3) as columns (3, N), the same brought into the box, and which of them were
        inside it (N,), None for all."""
        p = np.ascontiguousarray(p_WQ.reshape(-1, 3).T)
        lower, upper = self.lower_W[:, None], self.upper_W[:, None]
        p_box = np.minimum(np.maximum(p, lower), upper)
        same = p == p_box  # false also for NaN
        return p, p_box, None if same.all() else same.all(axis=0)

    def _cell(self, p_box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corner values (2, 2, 2, N), fractions (3, N) and index (3, N) of the points' cells."""
        position = (p_box - self._first_center_W) / self.voxel_size
        # fmax and fmin let no NaN into an index; it stays in the fractions and so in the result.
        cell = np.fmin(np.fmax(np.floor(position), 0.0), self._last_cell)
        base = self._strides @ cell.astype(np.intp)
        corners = self.distances.take(self._corner_offsets + base).astype(float)
        return corners, position - cell, cell

    def _extend(
        self, value: np.ndarray, p: np.ndarray, p_box: np.ndarray, inside: np.ndarray
    ) -> np.ndarray:
        """The values (N,) with those of points outside the box replaced by what holds there."""
        if self.occupied_outside:
            return value - np.linalg.norm(p - p_box, axis=0)
        return np.where(inside, value, np.nan)


def _points(p_WQ: ArrayLike) -> np.ndarray:
    p_WQ = np.asarray(p_WQ, dtype=float)
    if p_WQ.shape[-1:] != (3,):
        raise ValueError(f"Esdf: points have shape {p_WQ.shape}; needed is (..., 3).")
    return p_WQ
