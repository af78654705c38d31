"""Analytic solids with exact signed distances.

Every kind of shape is a dataclass whose static methods take the `parameters()` of M of its kind as
arrays (M, ...). They broadcast: points (N, 1, 3) give all pairs (N, M), and points (M, 3) matched
pairs (M,). `parameters()` raises ValueError on a value out of range, naming it and its limit. O is
a shape's own frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.spatial.distance import cdist

from splatpilot import _native
from splatpilot.systems.collision.distance_field import (
    DistanceField,
    Distances,
    FieldSample,
    FieldState,
)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: centre p_WO (3,) [m], radius [m]."""

    p_WO: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """Centre (3,) and radius [m]."""
        return as_point(self.p_WO, "Sphere.p_WO"), _positive(self.radius, "Sphere.radius")

    @staticmethod
    def distances(p: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Signed distances (...,) [m] of points p (..., 3) [m], negative inside."""
        return _norm(p - center) - radius

    @staticmethod
    def gradients(p: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Gradients (..., 3) of the distances at points p (..., 3) [m]: outward unit normals."""
        return _unit(p - center)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius [m] of the segment from p_WA to p_WB, (3,) [m] each."""

    p_WA: ArrayLike
    p_WB: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """End (3,) [m], unit axis (3,), length and radius [m]."""
        p_WA, axis, length = _segment(self.p_WA, self.p_WB, "Capsule")
        return p_WA, axis, length, _positive(self.radius, "Capsule.radius")

    @staticmethod
    def distances(
        p: np.ndarray, end: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
        """Signed distances (...,) [m] of points p (..., 3) [m], negative inside."""
        return _norm(Capsule._from_segment(p, end, axis, length)) - radius

    @staticmethod
    def gradients(
        p: np.ndarray, end: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
        """Gradients (..., 3) of the distances at points p (..., 3) [m]: outward unit normals."""
        return _unit(Capsule._from_segment(p, end, axis, length), axis)

    @staticmethod
    def _from_segment(
        p: np.ndarray, end: np.ndarray, axis: np.ndarray, length: np.ndarray
    ) -> np.ndarray:
        """The vectors (..., 3) to the points from the nearest points of the segments."""
        from_end = p - end
        along = np.minimum(np.maximum(_dot(from_end, axis), 0.0), length)
        return from_end - along[..., None] * axis


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A solid cylinder with flat ends centred at p_WA and p_WB, (3,) [m] each, and a radius [m]."""

    p_WA: ArrayLike
    p_WB: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        """Centre (3,) [m], unit axis (3,), half length and radius [m]."""
        p_WA, axis, length = _segment(self.p_WA, self.p_WB, "Cylinder")
        half = 0.5 * length
        return p_WA + half * axis, axis, half, _positive(self.radius, "Cylinder.radius")

    @staticmethod
    def distances(
        p: np.ndarray, center: np.ndarray, axis: np.ndarray, half: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
        """Signed distances (...,) [m] of points p (..., 3) [m], negative inside."""
        from_center = p - center
        along = _dot(from_center, axis)
        across = _norm(from_center - along[..., None] * axis)
        beyond_end, beyond_side = np.abs(along) - half, across - radius
        outside = np.hypot(np.maximum(beyond_end, 0.0), np.maximum(beyond_side, 0.0))
        return outside + np.minimum(np.maximum(beyond_end, beyond_side), 0.0)

    @staticmethod
    def gradients(
        p: np.ndarray, center: np.ndarray, axis: np.ndarray, half: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
        """Gradients (..., 3) of the distances at points p (..., 3) [m]: outward unit normals."""
        from_center = p - center
        along = _dot(from_center, axis)
        radial = from_center - along[..., None] * axis
        beyond_end, beyond_side = np.abs(along) - half, _norm(radial) - radius
        outside = (beyond_end > 0.0) | (beyond_side > 0.0)
        end = np.where(outside, np.maximum(beyond_end, 0.0), beyond_end >= beyond_side)
        side = np.where(outside, np.maximum(beyond_side, 0.0), beyond_end < beyond_side)
        to_end = np.copysign(end, along)[..., None] * axis
        return _unit(to_end + side[..., None] * _unit(radial, axis))


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box: pose X_WO of its centre, edge lengths `size` (3,) [m] along its own axes."""

    X_WO: RigidTransform
    size: ArrayLike

    def parameters(self) -> tuple[Any, ...]:
        """Centre (3,) [m], rotation R_WS (3, 3) and half sizes (3,) [m]."""
        size = as_point(self.size, "Box.size")
        if (size <= 0.0).any():
            raise ValueError(f"Box.size is {size} m; each edge must be positive.")
        return self.X_WO.translation(), self.X_WO.rotation().matrix(), 0.5 * size

    @staticmethod
    def distances(
        p: np.ndarray, center: np.ndarray, rotation: np.ndarray, half: np.ndarray
    ) -> np.ndarray:
        """Signed distances (...,) [m] of points p (..., 3) [m], negative inside."""
        # By component: numpy is several times slower along a last axis of three.
        d = [p[..., i] - center[..., i] for i in range(3)]
        along = [sum(d[j] * rotation[..., j, i] for j in range(3)) for i in range(3)]
        x, y, z = (np.abs(along[i]) - half[..., i] for i in range(3))
        outside = sum(np.maximum(beyond, 0.0) ** 2 for beyond in (x, y, z))
        return np.sqrt(outside) + np.minimum(np.maximum(np.maximum(x, y), z), 0.0)

    @staticmethod
    def gradients(
        p: np.ndarray, center: np.ndarray, rotation: np.ndarray, half: np.ndarray
    ) -> np.ndarray:
        """Gradients (..., 3) of the distances at points p (..., 3) [m]: outward unit normals."""
        local = _to_local(p - center, rotation)
        beyond = np.abs(local) - half
        nearest_face = beyond.argmax(axis=-1)[..., None] == np.arange(3)
        outside = (beyond > 0.0).any(axis=-1, keepdims=True)
        way = np.where(outside, np.maximum(beyond, 0.0), nearest_face)
        return _unit(_dot(rotation, np.copysign(way, local)[..., None, :]))


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """All points with normal . p_WQ <= offset [m]; the normal (3,) points out of the solid.

    The ground at height h is HalfSpace([0, 0, 1], h). The normal is normalised.
    """

    normal: ArrayLike
    offset: float

    def parameters(self) -> tuple[Any, ...]:
        """Unit normal (3,) and offset [m]."""
        normal = as_point(self.normal, "HalfSpace.normal")
        length = np.linalg.norm(normal)
        if length == 0.0:
            raise ValueError("HalfSpace.normal is zero; it must have a direction.")
        return normal / length, float(self.offset)

    @staticmethod
    def distances(p: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Signed distances (...,) [m] of points p (..., 3) [m], negative inside."""
        return _dot(p, normal) - offset

    @staticmethod
    def gradients(p: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Gradients (..., 3) of the distances at points p (..., 3) [m]: outward unit normals."""
        return np.broadcast_to(normal, p.shape)


Shape = Sphere | Capsule | Cylinder | Box | HalfSpace

_KINDS = {kind: number for number, kind in enumerate(get_args(Shape))}
_ROW = 15
"""Numbers that describe a shape, those of a box; others have zeros after their own."""


def shape_rows(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Shapes as native code takes them: their parameters (M, 15) and kinds (M,) uint8.

    Raises:
        ValueError: on a shape out of range.
    """
    rows = np.zeros((len(shapes), _ROW))
    for row, shape in zip(rows, shapes, strict=True):
        numbers = np.concatenate([np.ravel(number) for number in shape.parameters()])
        row[: len(numbers)] = numbers
    return rows, np.array([_KINDS[type(shape)] for shape in shapes], np.uint8)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _norm(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))


def _unit(a: np.ndarray, axis: np.ndarray | None = None) -> np.ndarray:
    """The vectors (..., 3) at unit length; zero ones become some unit vector, one perpendicular to
    the unit vector `axis` (..., 3) if that is given."""
    length = _norm(a)[..., None]
    if length.all():
        return a / length
    fallback = np.array([1.0, 0.0, 0.0])
    if axis is not None:
        least = np.abs(axis).argmin(axis=-1)[..., None] == np.arange(3)
        fallback = _unit(np.cross(axis, least))
    return np.where(length > 0.0, a / np.where(length > 0.0, length, 1.0), fallback)


def _to_local(a: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.einsum("...ji,...j->...i", rotation, a)


def as_point(value: Any, name: str) -> np.ndarray:
    """`value` as an array (3,), or a ValueError that calls it `name`."""
    point = np.asarray(value, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} is {value}; needed are 3 finite coordinates [m].")
    return point


def _positive(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value} m; it must be positive.")
    return float(value)


def _segment(p_WA: Any, p_WB: Any, name: str) -> tuple[np.ndarray, np.ndarray, float]:
    """End, unit axis and length of a segment."""
    p_WA, p_WB = as_point(p_WA, f"{name}.p_WA"), as_point(p_WB, f"{name}.p_WB")
    length = float(np.linalg.norm(p_WB - p_WA))
    if length == 0.0:
        raise ValueError(f"{name}: both ends are at {p_WA}; they must differ. Use a Sphere.")
    return p_WA, (p_WB - p_WA) / length, length


class AnalyticDistanceField:
    """The distance field of a union of shapes: the minimum of their signed distances.

    Exact outside the shapes and inside a shape that overlaps no other; where shapes overlap the
    depth is that of the deepest single shape, less than the union's. Every point inside the bounds
    is FREE or OCCUPIED; where the gradient is not unique (the axis of a cylinder, points equally
    far from two shapes) it is one of the candidates. Outside the bounds: NaN, zero, OUTSIDE.

    Args:
        shapes: of any kinds, in any order; may be empty, and the distance then is infinite.
        lower_W, upper_W: (3,) [m], the bounds.

    Raises:
        ValueError: for shapes with a size that is not positive, coordinates that are not finite, or
            empty bounds.
    """

    def __init__(self, shapes: Sequence[Shape], lower_W: ArrayLike, upper_W: ArrayLike) -> None:
        self.lower_W = as_point(lower_W, "AnalyticDistanceField.lower_W").copy()
        self.upper_W = as_point(upper_W, "AnalyticDistanceField.upper_W").copy()
        if (self.lower_W >= self.upper_W).any():
            raise ValueError(
                f"AnalyticDistanceField: the bounds from {self.lower_W} to {self.upper_W} m are "
                "empty; upper_W must exceed lower_W along each axis."
            )
        self.shapes = tuple(shapes)
        kinds = dict.fromkeys(type(shape) for shape in self.shapes)
        # Shapes of one kind stand together: of those equally far the first is the nearest.
        ordered = [shape for kind in kinds for shape in self.shapes if type(shape) is kind]
        rows, numbers = shape_rows(ordered)
        self._native = _native.ShapeField(shapes=rows, kinds=numbers)
        # Of each kind its first shape, and the shapes' parameters, stacked: arrays with a leading
        # axis (M,).
        self._groups, first = [], 0
        for kind in kinds:
            own = [shape.parameters() for shape in ordered if type(shape) is kind]
            parameters = tuple(np.array(values) for values in zip(*own, strict=True))
            self._groups.append((kind, first, len(own), parameters))
            first += len(own)

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Signed distance at the points p_WQ (..., 3) [m]: (...,) [m], NaN outside the bounds."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        distance, _, _ = self._nearest(p_WQ.reshape(-1, 3), with_gradient=False)
        return distance.reshape(p_WQ.shape[:-1])

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Distance, gradient and state at the points p_WQ (..., 3) [m]."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        distance, gradient, inside = self._nearest(p_WQ.reshape(-1, 3), with_gradient=True)
        state = np.where(distance < 0.0, FieldState.OCCUPIED, FieldState.FREE)
        state = np.where(inside, state, FieldState.OUTSIDE).astype(np.uint8)
        shape = p_WQ.shape[:-1]
        return FieldSample(
            distance.reshape(shape), gradient.reshape(p_WQ.shape), state.reshape(shape)
        )

    def _nearest(
        self, p: np.ndarray, with_gradient: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of points (N, 3): distance (N,), gradient (N, 3) (zero unless asked for), inside (N,)."""
        inside = ((p >= self.lower_W) & (p <= self.upper_W)).all(axis=1)
        distance, shape = np.empty(len(p)), np.empty(len(p), np.int64)
        self._native.nearest(p_WQ=np.ascontiguousarray(p), distances=distance, shapes=shape)
        gradient = np.zeros_like(p)
        if with_gradient:
            for kind, first, count, parameters in self._groups:
                own = np.flatnonzero((shape >= first) & (shape < first + count))
                if len(own):
                    nearest = shape[own] - first
                    gradient[own] = kind.gradients(p[own], *(v[nearest] for v in parameters))
        if not inside.all():
            distance[~inside] = np.nan
            gradient[~inside] = 0.0
        return distance, gradient, inside


class MovingBalls:
    """M balls whose places are functions of time alone.

    Each follows a path of its own, a row every `period`, and stands still in between; at the end
    of its path it turns back, and at the beginning again. A row of infinities is a time at which
    the ball is nowhere.

    Args:
        radii: (M,) [m].
        paths: M arrays (rows, 3) of centres p_WO [m], of any numbers of rows.
        period: [s].

    Raises:
        ValueError: unless there is a path with at least one row for each radius, and radii and
            period are positive.
    """

    def __init__(self, radii: ArrayLike, paths: Sequence[NDArray], period: float) -> None:
        self.radii = np.asarray(radii, dtype=float)
        self._last = np.array([len(path) - 1 for path in paths])
        if len(self._last) != len(self.radii) or (self._last < 0).any():
            raise ValueError(
                f"MovingBalls: {len(self.radii)} radii and {len(paths)} paths of "
                f"{(self._last + 1).tolist()} rows; give one of at least one row for each radius"
            )
        if not (self.radii > 0).all() or not period > 0:
            raise ValueError(
                f"MovingBalls: radii of {self.radii.tolist()} m and a period of {period} s must be "
                "positive"
            )
        self._rows = np.concatenate([np.zeros((0, 3)), *paths])
        self._first = np.cumsum(self._last + 1) - self._last - 1
        self._period = period

    def centers(self, time: float) -> NDArray[np.float64]:
        """Where the balls are at a time [s]: (M, 3) [m]."""
        # Steps that end on a row reach it, however the time was rounded.
        step = int(np.floor(time / self._period + 1e-6))
        there_and_back = step % np.maximum(2 * self._last, 1)
        return self._rows[self._first + np.minimum(there_and_back, 2 * self._last - there_and_back)]

    def among(self, field: DistanceField, time: float) -> "FieldWithBalls":
        """A distance field with the balls in it, where they are at a time [s]."""
        return FieldWithBalls(field, self.centers(time), self.radii)

    def along(self, field: DistanceField, times: ArrayLike) -> "DistancesAlongTrajectories":
        """Distances, in a field with the balls in it, of trajectories sampled at `times` (S,)."""
        return DistancesAlongTrajectories(
            [self.among(field, float(time)) for time in np.asarray(times)]
        )


class FieldWithBalls:
    """The union of a distance field and balls: the nearer of both, where the field is known.

    Args:
        field: everything else.
        centers: (M, 3) [m], infinite for balls that are nowhere.
        radii: (M,) [m].
    """

    def __init__(self, field: DistanceField, centers: NDArray, radii: NDArray) -> None:
        present = np.isfinite(centers).all(axis=1)
        self._field, self._centers, self._radii = field, centers[present], radii[present]
        self.lower_W, self.upper_W = field.lower_W, field.upper_W

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Signed distance at the points p_WQ (..., 3) [m]: (...,) [m], NaN where the field's is."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        to_balls = self._to_balls(p_WQ).min(axis=1, initial=np.inf)
        return np.minimum(self._field.distance(p_WQ), to_balls.reshape(p_WQ.shape[:-1]))

    def query(self, p_WQ: ArrayLike) -> FieldSample:
        """Distance, gradient and state at the points p_WQ (..., 3) [m]."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        distance, gradient, state = self._field.query(p_WQ)
        if not len(self._radii):
            return FieldSample(distance, gradient, state)
        to_balls = self._to_balls(p_WQ)
        nearest = to_balls.argmin(axis=1)
        to_nearest = to_balls[np.arange(len(nearest)), nearest].reshape(distance.shape)
        out = p_WQ - self._centers[nearest].reshape(p_WQ.shape)
        length = np.linalg.norm(out, axis=-1, keepdims=True)
        normal = np.divide(out, length, out=np.zeros_like(out), where=length > 0)
        closer = to_nearest < distance
        # In a ball a point is known to be occupied, also where nobody looked.
        inside = closer & (to_nearest < 0) & (state < FieldState.OUTSIDE)
        return FieldSample(
            np.where(closer, to_nearest, distance),
            np.where(closer[..., None], normal, gradient),
            np.where(inside, FieldState.OCCUPIED, state).astype(np.uint8),
        )

    def _to_balls(self, p_WQ: np.ndarray) -> np.ndarray:
        """Signed distances (N, M) [m] of all points to all balls."""
        return cdist(p_WQ.reshape(-1, 3), self._centers) - self._radii


class DistancesAlongTrajectories:
    """Distances of trajectories, each sample's in a field of its own.

    Args:
        fields: S of them.
    """

    def __init__(self, fields: Sequence[Distances]) -> None:
        self._fields = fields

    def distance(self, p_WQ: ArrayLike) -> np.ndarray:
        """Signed distances (N, S) [m] of the samples p_WQ (N, S, 3) [m] of N trajectories."""
        p_WQ = np.asarray(p_WQ, dtype=float)
        samples = zip(self._fields, p_WQ.swapaxes(0, 1), strict=True)
        return np.column_stack([field.distance(p) for field, p in samples])
