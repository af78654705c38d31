"""Observations of a captured environment: how often, and from where, images saw each surface; and
the frontier, where observed free space ends."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.ndimage import binary_dilation, label, maximum_filter

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import (
    Esdf,
    distance_to_voxels,
    neighbor_slices,
    occupancy_distances,
)
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import read_archive
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.lens import pixel_slopes

FORMAT_VERSION = 1
HEADINGS = 8  # of a table of views, counterclockwise from the x axis

_WIDTH = 160  # [px] approximate width to which depth images are subsampled
_BITS = 21  # of a voxel's index along each axis, in its key
# Of confirmed surfaces: in a room of 39 photographs, space wrongly free fell from 187 to 20 m^3.
_MIN_IMAGES, _MIN_PARALLAX = 3, math.radians(12.0)
_MIN_COSINE = 0.5  # of the angle between two views of a surface that agree
# Directions are those to the 26 neighbors of a voxel; the middle one, number 13, is not used.
_AXES = np.array(list(itertools.product((-1, 0, 1), repeat=3)))  # (27, 3)
_UNIT = _AXES / np.maximum(np.linalg.norm(_AXES, axis=1, keepdims=True), 1.0)
_FLAGS = np.uint32(1) << np.arange(27, dtype=np.uint32)


@dataclass(frozen=True, eq=False)
class Observations:
    """Observed voxels, sparse, in ascending order of their keys."""

    voxel_size: float  # [m], edge of a voxel; voxel (i, j, k) begins at (i, j, k) voxel_size
    voxels: NDArray[np.int32]  # (V, 3), their indices
    counts: NDArray[np.uint16]  # (V,), number of images that saw a surface in the voxel
    directions: NDArray[np.uint32]  # (V,), a bit for each direction from which they saw it
    # Table of views: the fraction of pixels that show no observed surface, of a level camera at
    # n points in `HEADINGS` directions; empty if not known.
    view_points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    unobserved: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, HEADINGS)))

    @classmethod
    def from_depth_images(
        cls,
        depths: Iterable[np.ndarray],
        K: np.ndarray,
        X_WCs: Sequence[RigidTransform],
        voxel_size: float,
    ) -> "Observations":
        """Counts the images that saw each voxel; see `esdf_from_depth_images` for the images."""
        keys, bits = [], []
        for depth, X_WC in zip(depths, X_WCs, strict=True):
            step = max(depth.shape[1] // _WIDTH, 1)
            key, p_QC = _seen_voxels(depth, K, X_WC, voxel_size, step)
            keys.append(key)
            bits.append(_FLAGS[np.argmax(p_QC @ _UNIT.T, axis=1)])
        key, order, counts = _grouped(keys)
        directions = np.bitwise_or.reduceat(np.concatenate(bits)[order], _starts(counts))
        counts = np.minimum(counts, np.iinfo(np.uint16).max).astype(np.uint16)
        return cls(float(voxel_size), _voxel(key).astype(np.int32), counts, directions)

    def agree_with(self, p_WQ: ArrayLike, p_WC: ArrayLike) -> NDArray[np.bool_]:
        """Checks which points (N, 3) [m] lie within a voxel of a surface that an image saw from at
        most about 60 degrees beside a camera at p_WC (3,) [m]."""
        p_WQ = np.asarray(p_WQ, float)
        ray = np.asarray(p_WC) - p_WQ
        cosine = ray @ _UNIT.T / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        allowed = ((cosine >= _MIN_COSINE) * _FLAGS).sum(axis=1, dtype=np.uint32)
        keys, directions = self._dilated
        return (_look_up(keys, directions, _keys_at(p_WQ, self.voxel_size)) & allowed) != 0

    @cached_property
    def _keys(self) -> NDArray[np.int64]:
        return _key(self.voxels.astype(np.int64))

    @cached_property
    def _dilated(self) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
        """Keys of all voxels within one of an observed one, and the directions of these."""
        keys, directions = self._keys, self.directions
        for offset in _key(np.eye(3, dtype=np.int64)) - _key(np.zeros(3, np.int64)):
            keys, order, counts = _grouped([keys - offset, keys, keys + offset])
            directions = np.bitwise_or.reduceat(np.tile(directions, 3)[order], _starts(counts))
        return keys, directions

    def with_surfaces(self, p_WQ: NDArray[np.float64]) -> "Observations":
        """Returns the voxels and those of points (N, 3) [m], which are seen from all directions."""
        added = np.unique(_keys_at(p_WQ, self.voxel_size))
        key, order, counts = _grouped([self._keys, added])
        seen = np.concatenate([self.counts, np.ones(len(added), np.uint16)])[order]
        directions = np.concatenate([self.directions, np.full(len(added), _FLAGS.sum(), np.uint32)])
        return replace(
            self,
            voxels=_voxel(key).astype(np.int32),
            counts=np.maximum.reduceat(seen, _starts(counts)),
            directions=np.bitwise_or.reduceat(directions[order], _starts(counts)),
        )

    def scaled_by(self, factor: float) -> "Observations":
        """Returns the voxels with all lengths from the origin times `factor`, without views."""
        size = factor * self.voxel_size
        return Observations(size, self.voxels, self.counts, self.directions)

    def save(self, path: str | Path) -> None:
        """Writes the voxels, by custom `observations.npz`, atomically."""
        with written_atomically(path) as partial, partial.open("wb") as file:
            np.savez_compressed(
                file,
                version=np.int64(FORMAT_VERSION),
                voxel_size=np.float64(self.voxel_size),
                voxels=self.voxels,
                counts=self.counts,
                directions=self.directions,
                view_points=self.view_points.astype(np.float32),
                unobserved=self.unobserved.astype(np.float32),
            )

    @classmethod
    def load(cls, path: str | Path) -> "Observations":
        """Reads voxels that `save` wrote; raises ValueError for other or damaged files."""
        archive = read_archive(Path(path))
        names = "voxel_size", "voxels", "counts", "directions", "view_points", "unobserved"
        missing = [name for name in ("version", *names) if name not in archive]
        require(not missing, f"{path}: arrays", "all of a scene's observations", f"no {missing}")
        version = int(archive["version"])
        require(version == FORMAT_VERSION, f"{path}: version", str(FORMAT_VERSION), version)
        size, voxels, counts, directions, points, unobserved = (archive[name] for name in names)
        number = len(voxels)
        valid = voxels.shape == (number, 3) and counts.shape == directions.shape == (number,)
        shapes = voxels.shape, counts.shape, directions.shape
        require(valid, f"{path}: voxels, counts and directions", "of equal length", shapes)
        valid = points.shape == (len(points), 3) and unobserved.shape == (len(points), HEADINGS)
        shapes = points.shape, unobserved.shape
        require(valid, f"{path}: views", f"of shapes (n, 3) and (n, {HEADINGS})", shapes)
        return cls(
            float(size), voxels, counts, directions, points.astype(float), unobserved.astype(float)
        )


def _points(
    depth: np.ndarray, K: np.ndarray, X_WC: RigidTransform, step: int, far: float = FAR
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Returns points p_WQ (n, 3) [m] of every `step`-th pixel of a depth image along both axes, and
    the mask (h, w) of those pixels that show a surface nearer than `far` [m]."""
    every = (slice(step // 2, None, step),) * 2
    z, slopes = depth[every], pixel_slopes(None, K, *depth.shape[::-1])[every]
    known = (z > 0.0) & (z < far)
    p_CQ = np.column_stack([slopes[known], np.ones(np.count_nonzero(known))]) * z[known, None]
    return p_CQ @ X_WC.rotation().matrix().T + X_WC.translation(), known


def _seen_voxels(
    depth: np.ndarray,
    K: np.ndarray,
    X_WC: RigidTransform,
    voxel_size: float,
    step: int,
    far: float = FAR,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the keys (V,) of the voxels of surfaces in every `step`-th pixel of an image, and
    p_QC (V, 3) [m], the camera seen from their centers."""
    p_WQ, _ = _points(depth, K, X_WC, step, far)
    key = np.unique(_keys_at(p_WQ, voxel_size))
    return key, X_WC.translation() - voxel_size * (_voxel(key) + 0.5)


class ConfirmedSurfaces:
    """Surfaces that several images show in the same voxel, from different directions: what is seen
    once, or from one direction, may be rendered too far away."""

    def __init__(
        self,
        depths: Iterable[np.ndarray],
        K: np.ndarray,
        X_WCs: Sequence[RigidTransform],
        voxel_size: float,
    ) -> None:
        """Finds the voxels that at least three images show, from directions that span at least 12
        degrees. For the images see `esdf_from_depth_images`."""
        keys, directions = [], []
        self._far = (1 << (_BITS - 2)) * voxel_size  # keys hold no farther points
        for depth, X_WC in zip(depths, X_WCs, strict=True):
            key, p_QC = _seen_voxels(depth, K, X_WC, voxel_size, 1, self._far)
            keys.append(key)
            directions.append(p_QC / np.linalg.norm(p_QC, axis=1, keepdims=True))
        key, order, counts = _grouped(keys)
        ordered, first = np.concatenate(directions)[order], _starts(counts)
        spread = np.maximum.reduceat(ordered, first) - np.minimum.reduceat(ordered, first)
        differ = np.linalg.norm(spread, axis=1) > 2.0 * math.sin(0.5 * _MIN_PARALLAX)
        self._keys = key[(counts >= _MIN_IMAGES) & differ]
        self._voxel_size, self._K = voxel_size, K

    def keep(self, depth: np.ndarray, X_WC: RigidTransform) -> NDArray[np.float32]:
        """Returns a depth image (H, W) [m] that is 0 at other surfaces; infinity stays."""
        p_WQ, known = _points(depth, self._K, X_WC, 1, self._far)
        every = np.ones(len(self._keys), dtype=bool)
        confirmed = _look_up(self._keys, every, _keys_at(p_WQ, self._voxel_size))
        kept = np.where(np.isinf(depth), depth, 0.0).astype(np.float32)
        kept[known] = depth[known] * confirmed
        return kept


def _key(voxel: NDArray) -> NDArray[np.int64]:
    """Packs indices (..., 3) into integers of the same order."""
    shifted = voxel + (1 << (_BITS - 1))
    return (shifted[..., 0] << 2 * _BITS) | (shifted[..., 1] << _BITS) | shifted[..., 2]


def _keys_at(p_WQ: NDArray[np.float64], voxel_size: float) -> NDArray[np.int64]:
    return _key(np.floor(p_WQ / voxel_size).astype(np.int64))


def _voxel(key: NDArray[np.int64]) -> NDArray[np.int64]:
    parts = [key >> 2 * _BITS, key >> _BITS, key]
    return (np.stack(parts, axis=-1) & ((1 << _BITS) - 1)) - (1 << (_BITS - 1))


def _grouped(
    keys: Sequence[NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.int64]]:
    """Returns the different keys, the order that sorts all of them, and the number of each."""
    every = np.concatenate(keys)
    order = np.argsort(every, kind="stable")
    unique, counts = np.unique(every[order], return_counts=True)
    return unique, order, counts


def _starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.cumsum(counts) - counts


def _look_up[T: np.generic](
    keys: NDArray[np.int64], values: NDArray[T], key: NDArray[np.int64]
) -> NDArray[T]:
    """Returns the values (V,) of sorted keys (V,) at others (N,), 0 for those that are missing."""
    if not len(keys):
        return np.zeros(key.shape, values.dtype)
    index = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
    return np.where(keys[index] == key, values[index], values.dtype.type(0))


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

    It begins two voxels behind the last one seen free, where an obstacle hides nothing captured,
    and not before the sky and surfaces beyond the field's range.

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
    """Returns the pixels (N,) of an image (H, W) that see points (N, 3) [m]; NaN beyond its inside:
    at its border rounding would decide."""
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
