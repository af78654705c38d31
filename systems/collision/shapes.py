"""Analytic solids with exact signed distances, and spheres that move."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from splatpilot import _native
from splatpilot.systems.collision.distance_field import (
    DistanceField,
    Distances,
    FieldSample,
    FieldState,
    sample_field,
)
from splatpilot.systems.common.drake import is_autodiff
from splatpilot.systems.common.validation import require

# The `parameters` of a shape are numbers as native code takes them; O is a shape's own frame.


@dataclass(frozen=True, eq=False)
class Sphere:
    """A solid sphere: center p_WO (3,) [m], radius [m]."""

    p_WO: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """Returns center (3,) and radius [m]."""
        return _point(self.p_WO, "Sphere.p_WO"), _radius(self)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius [m] of the segment from p_WA to p_WB, (3,) [m] each."""

    p_WA: ArrayLike
    p_WB: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """Returns end (3,) [m], unit axis (3,), length and radius [m]."""
        return *_segment(self), _radius(self)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A solid cylinder with flat ends centered at p_WA and p_WB, (3,) [m] each; radius [m]."""

    p_WA: ArrayLike
    p_WB: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """Returns center (3,) [m], unit axis (3,), half length and radius [m]."""
        p_WA, axis, length = _segment(self)
        return p_WA + 0.5 * length * axis, axis, 0.5 * length, _radius(self)


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box: pose X_WO of its center, edge lengths `size` (3,) [m] along its own axes."""

    X_WO: RigidTransform
    size: ArrayLike

    def parameters(self) -> tuple[Any, ...]:
        """Returns center (3,) [m], rotation R_WO (3, 3) and half sizes (3,) [m]."""
        size = _point(self.size, "Box.size")
        require((size > 0.0).all(), "Box.size", "> 0 m along each axis", size)
        return self.X_WO.translation(), self.X_WO.rotation().matrix(), 0.5 * size


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """All points with normal . p_WQ <= offset [m]; the normal (3,) points out of the solid.

    The ground at height h is HalfSpace([0, 0, 1], h). The normal is normalized.
    """

    normal: ArrayLike
    offset: float

    def parameters(self) -> tuple[Any, ...]:
        """Returns unit normal (3,) and offset [m]."""
        normal = _point(self.normal, "HalfSpace.normal")
        length = np.linalg.norm(normal)
        require(length > 0.0, "HalfSpace.normal", "a direction", normal)
        return normal / length, float(self.offset)


Shape = Sphere | Capsule | Cylinder | Box | HalfSpace

_KINDS = {kind: number for number, kind in enumerate(get_args(Shape))}
_ROW = 15  # parameters of a box; other shapes have fewer


def shape_rows(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Returns shapes as native code takes them: parameters (M, 15) and kinds (M,) uint8."""
    rows = np.zeros((len(shapes), _ROW))
    for row, shape in zip(rows, shapes, strict=True):
        numbers = np.concatenate([np.ravel(number) for number in shape.parameters()])
        row[: len(numbers)] = numbers
    return rows, np.array([_KINDS[type(shape)] for shape in shapes], np.uint8)


def _point(value: Any, name: str) -> np.ndarray:
    point = np.asarray(value, dtype=float)
    valid = point.shape == (3,) and np.isfinite(point).all()
    require(valid, name, "3 finite coordinates [m]", value)
    return point


def _radius(shape: Sphere | Capsule | Cylinder) -> float:
    radius = float(shape.radius)
    valid = np.isfinite(radius) and radius > 0.0
    require(valid, f"{type(shape).__name__}.radius", "in (0, inf) m", radius)
    return radius


def _segment(shape: Capsule | Cylinder) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns end, unit axis and length of a segment."""
    name = type(shape).__name__
    p_WA, p_WB = _point(shape.p_WA, f"{name}.p_WA"), _point(shape.p_WB, f"{name}.p_WB")
    length = float(np.linalg.norm(p_WB - p_WA))
    require(length > 0.0, f"{name}.p_WB", f"apart from p_WA = {p_WA}", p_WB, "use a Sphere")
    return p_WA, (p_WB - p_WA) / length, length


class ShapeUnion:
    """The union of shapes in unbounded space: the minimum of their signed distances.

    Exact outside the shapes and inside a shape that overlaps no other; where shapes overlap the
    depth is that of the deepest single shape, less than the union's.
    """

    def __init__(self, rows: np.ndarray, kinds: np.ndarray) -> None:
        """Constructs the union of shapes given as by `shape_rows`."""
        self._native = _native.ShapeField(shapes=rows, kinds=kinds)

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> "ShapeUnion":
        return cls(*shape_rows(shapes))

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Returns signed distances (...,) [m] at p_WQ (..., 3) [m]; infinite without shapes."""
        return self.nearest(p_WQ, with_gradient=False)[0]

    def nearest(self, p_WQ: ArrayLike, with_gradient: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Returns signed distances (...,) [m] at p_WQ (..., 3) [m] and their gradients (..., 3).

        If the gradient is not unique, as on the axis of a cylinder, it is one of the candidates.
        """
        points = np.ascontiguousarray(p_WQ, dtype=float)
        distances, gradients = np.empty(points.shape[:-1]), np.empty(points.shape)
        outputs: dict[str, np.ndarray] = {"distances": distances.reshape(-1)}
        if with_gradient:
            outputs["gradients"] = gradients.reshape(-1, 3)
        self._native.nearest(p_WQ=points.reshape(-1, 3), **outputs)
        return distances, gradients


class AnalyticDistanceField:
    """The distance field of a `ShapeUnion` within the bounds [lower_W, upper_W]."""

    def __init__(self, shapes: Sequence[Shape], lower_W: ArrayLike, upper_W: ArrayLike) -> None:
        self.lower_W = _point(lower_W, "lower_W").copy()
        self.upper_W = _point(upper_W, "upper_W").copy()
        valid = (self.lower_W < self.upper_W).all()
        require(valid, "upper_W", f"above lower_W = {self.lower_W} along each axis", self.upper_W)
        self.shapes = tuple(shapes)
        self._union = ShapeUnion.of(self.shapes)

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Returns signed distances (...,) [m] at p_WQ (..., 3) [m], NaN outside the bounds."""
        if is_autodiff(p_WQ):
            return sample_field(self, p_WQ).distance
        p_WQ = np.asarray(p_WQ, dtype=float)
        return np.where(self._contains(p_WQ), self._union.distance(p_WQ), np.nan)

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Returns distance, gradient and state at the points p_WQ (..., 3) [m]."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        distance, gradient = self._union.nearest(p_WQ)
        inside = self._contains(p_WQ)
        state = np.where(distance < 0.0, FieldState.OCCUPIED, FieldState.FREE)
        return FieldSample(
            np.where(inside, distance, np.nan),
            np.where(inside[..., None], gradient, 0.0),
            np.where(inside, state, FieldState.OUTSIDE).astype(np.uint8),
        )

    def _contains(self, p_WQ: np.ndarray) -> np.ndarray:
        return ((p_WQ >= self.lower_W) & (p_WQ <= self.upper_W)).all(axis=-1)


class SpheresInTime:
    """Base class of spheres whose positions depend on time."""

    radii: Any  # (M,) [m]

    def centers(self, time: float) -> NDArray[np.float64]:
        """Returns the centers (M, 3) [m] at a time [s]; infinite for an absent sphere."""
        raise NotImplementedError

    def among(self, field: DistanceField, time: float) -> "FieldWithSpheres":
        """Returns a distance field with the spheres at a time [s]."""
        return FieldWithSpheres(field, self.centers(time), self.radii)

    def along(self, field: DistanceField, times: ArrayLike) -> "DistancesAlongTrajectories":
        """Returns the distances of trajectories sampled at `times` (S,), with the spheres."""
        return DistancesAlongTrajectories([self.among(field, t) for t in np.asarray(times, float)])


class MovingSpheres(SpheresInTime):
    """M spheres of `radii` (M,) [m] that follow given paths back and forth.

    Each has a row (3,) [m] of its path, one at least, per `period` [s] and rests in between. A row
    of infinities means that the sphere is absent.
    """

    def __init__(self, radii: ArrayLike, paths: Sequence[NDArray], period: float) -> None:
        self.radii = np.asarray(radii, dtype=float)
        rows = [len(path) for path in paths]
        valid = len(rows) == len(self.radii) and all(rows)
        require(valid, "paths", f"{len(self.radii)}, like radii, of at least one row each", rows)
        require((self.radii > 0.0).all(), "radii", "> 0 m", self.radii.tolist())
        require(period > 0.0, "period", "> 0 s", period)
        self._paths = list(paths)
        self._last = np.array(rows, dtype=int) - 1
        self._rows = np.concatenate([np.zeros((0, 3)), *paths])
        self._first = np.cumsum(self._last + 1) - self._last - 1
        self._period = period

    def centers(self, time: float) -> NDArray[np.float64]:
        """Returns the centers (M, 3) [m] at a time [s]."""
        # Steps that end on a row reach it, however the time was rounded.
        step = int(np.floor(time / self._period + 1e-6))
        forward = step % np.maximum(2 * self._last, 1)
        return self._rows[self._first + np.minimum(forward, 2 * self._last - forward)]

    def merged_with(self, other: "MovingSpheres") -> "MovingSpheres":
        """Returns the spheres of both; their periods must be equal."""
        require(self._period == other._period, "period", f"{self._period} s", other._period)
        radii = np.append(self.radii, other.radii)
        return MovingSpheres(radii, [*self._paths, *other._paths], self._period)


class FieldWithSpheres:
    """The union of a distance field and spheres, without those of infinite centers or radius 0."""

    def __init__(self, field: DistanceField, centers: NDArray, radii: NDArray) -> None:
        present = np.isfinite(centers).all(axis=1) & (np.asarray(radii) > 0.0)
        self._field = field
        rows = np.zeros((np.count_nonzero(present), _ROW))
        rows[:, :3], rows[:, 3] = centers[present], radii[present]
        self._spheres = ShapeUnion(rows, np.full(len(rows), _KINDS[Sphere], np.uint8))
        self.lower_W, self.upper_W = field.lower_W, field.upper_W

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Returns signed distances (...,) [m] at p_WQ (..., 3) [m], NaN where the field's are."""
        if is_autodiff(p_WQ):
            return sample_field(self, p_WQ).distance
        return np.minimum(self._field.distance(p_WQ), self._spheres.distance(p_WQ))

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Returns distance, gradient and state at the points p_WQ (..., 3) [m]."""
        distance, gradient, state = self._field.query(p_WQ)
        to_spheres, normal = self._spheres.nearest(p_WQ)
        closer = to_spheres < distance
        # The inside of a sphere is occupied, also in unobserved space.
        inside = closer & (to_spheres < 0) & (state < FieldState.OUTSIDE)
        return FieldSample(
            np.where(closer, to_spheres, distance),
            np.where(closer[..., None], normal, gradient),
            np.where(inside, FieldState.OCCUPIED, state).astype(np.uint8),
        )


class DistancesAlongTrajectories:
    """Distances of trajectories, each sample's in a field of its own, of S fields."""

    def __init__(self, fields: Sequence[Distances]) -> None:
        self._fields = fields

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Returns signed distances (N, S) [m] of the samples p_WQ (N, S, 3) [m]."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        samples = zip(self._fields, p_WQ.swapaxes(0, 1), strict=True)
        return np.column_stack([field.distance(p) for field, p in samples])
