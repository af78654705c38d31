"""Analytic solids with exact signed distances, and the distance field of their union.

Every kind of shape is a dataclass whose static methods take its parameters as arrays: `distances`
broadcasts points (..., 3) against parameters (M, ...), so it serves all pairs, points (N, 1, 3),
and matched pairs, points (N, 3), alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from flysplat.systems.collision.distance_field import FieldSample, FieldState


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: centre p_WS (3,) [m], radius [m]."""

    p_WS: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        return _point(self.p_WS, "Sphere.p_WS"), _positive(self.radius, "Sphere.radius")

    @staticmethod
    def distances(p: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
        return _norm(p - center) - radius

    @staticmethod
    def gradients(p: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
        return _unit(p - center)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius [m] of the segment from p_WA to p_WB, (3,) [m] each."""

    p_WA: ArrayLike
    p_WB: ArrayLike
    radius: float

    def parameters(self) -> tuple[Any, ...]:
        p_WA, axis, length = _segment(self.p_WA, self.p_WB, "Capsule")
        return p_WA, axis, length, _positive(self.radius, "Capsule.radius")

    @staticmethod
    def distances(
        p: np.ndarray, end: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
        return _norm(Capsule._from_segment(p, end, axis, length)) - radius

    @staticmethod
    def gradients(
        p: np.ndarray, end: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
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
        p_WA, axis, length = _segment(self.p_WA, self.p_WB, "Cylinder")
        half = 0.5 * length
        return p_WA + half * axis, axis, half, _positive(self.radius, "Cylinder.radius")

    @staticmethod
    def distances(
        p: np.ndarray, center: np.ndarray, axis: np.ndarray, half: np.ndarray, radius: np.ndarray
    ) -> np.ndarray:
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
    """A solid box: pose X_WS of its centre, edge lengths `size` (3,) [m] along its own axes."""

    X_WS: RigidTransform
    size: ArrayLike

    def parameters(self) -> tuple[Any, ...]:
        size = _point(self.size, "Box.size")
        if (size <= 0.0).any():
            raise ValueError(f"Box.size is {size} m; each edge must be positive.")
        return self.X_WS.translation(), self.X_WS.rotation().matrix(), 0.5 * size

    @staticmethod
    def distances(
        p: np.ndarray, center: np.ndarray, rotation: np.ndarray, half: np.ndarray
    ) -> np.ndarray:
        beyond = np.abs(_to_local(p - center, rotation)) - half
        return _norm(np.maximum(beyond, 0.0)) + np.minimum(beyond.max(axis=-1), 0.0)

    @staticmethod
    def gradients(
        p: np.ndarray, center: np.ndarray, rotation: np.ndarray, half: np.ndarray
    ) -> np.ndarray:
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
        normal = _point(self.normal, "HalfSpace.normal")
        length = np.linalg.norm(normal)
        if length == 0.0:
            raise ValueError("HalfSpace.normal is zero; it must have a direction.")
        return normal / length, float(self.offset)

    @staticmethod
    def distances(p: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        return _dot(p, normal) - offset

    @staticmethod
    def gradients(p: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        return np.broadcast_to(normal, p.shape)


Shape = Sphere | Capsule | Cylinder | Box | HalfSpace


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

    # Points handled at once. Points near each other share their candidates for the nearest shape.
    _BATCH = 512

    def __init__(self, shapes: Sequence[Shape], lower_W: ArrayLike, upper_W: ArrayLike) -> None:
        self.lower_W = _point(lower_W, "AnalyticDistanceField.lower_W").copy()
        self.upper_W = _point(upper_W, "AnalyticDistanceField.upper_W").copy()
        if (self.lower_W >= self.upper_W).any():
            raise ValueError(
                f"AnalyticDistanceField: the bounds from {self.lower_W} to {self.upper_W} m are "
                "empty; upper_W must exceed lower_W along each axis."
            )
        self.shapes = tuple(shapes)
        kinds = dict.fromkeys(type(shape) for shape in self.shapes)
        # Of each kind the shapes' parameters, stacked: arrays with a leading axis (M,).
        self._groups = [
            (
                kind,
                tuple(
                    np.array(values)
                    for values in zip(
                        *(s.parameters() for s in self.shapes if type(s) is kind), strict=True
                    )
                ),
            )
            for kind in kinds
        ]

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
        distance = np.full(len(p), np.inf)
        gradient = np.zeros_like(p)
        for start in range(0, len(p), self._BATCH):
            part = slice(start, start + self._BATCH)
            self._nearest_of_batch(
                p[part], distance[part], gradient[part] if with_gradient else None
            )
        if not inside.all():
            distance[~inside] = np.nan
            gradient[~inside] = 0.0
        return distance, gradient, inside

    def _nearest_of_batch(
        self, p: np.ndarray, distance: np.ndarray, gradient: np.ndarray | None
    ) -> None:
        """Fills distance (N,) and gradient (N, 3) of points (N, 3)."""
        groups = self._groups if len(p) < 32 else self._near(p)
        for kind, parameters in groups:
            of_kind = kind.distances(p[:, None, :], *parameters)  # (N, M)
            nearest = of_kind.argmin(axis=1)
            nearest_distance = of_kind[np.arange(len(p)), nearest]
            if gradient is None:
                np.minimum(distance, nearest_distance, out=distance)
                continue
            closer = np.flatnonzero(nearest_distance < distance)
            if len(closer):
                own = (values[nearest[closer]] for values in parameters)
                gradient[closer] = kind.gradients(p[closer], *own)
                distance[closer] = nearest_distance[closer]

    def _near(self, p: np.ndarray) -> list[tuple[type[Shape], tuple[np.ndarray, ...]]]:
        """The groups with those shapes only that can be nearest to one of the points (N, 3).

        Distances are 1-Lipschitz: within R of a centre c the nearest shape is at most min d(c) + R
        away, so a shape with d(c) > min d(c) + 2 R is nowhere the nearest.
        """
        lower, upper = p.min(axis=0), p.max(axis=0)
        center, reach = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
        at_center = [kind.distances(center, *values) for kind, values in self._groups]
        limit = min((d.min() for d in at_center), default=0.0) + reach + 1e-9
        near = []
        for (kind, parameters), d in zip(self._groups, at_center, strict=True):
            keep = ~(d > limit)  # keeps all when a point is not finite
            if keep.any():
                near.append((kind, tuple(values[keep] for values in parameters)))
        return near


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


def _point(value: Any, name: str) -> np.ndarray:
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
    p_WA, p_WB = _point(p_WA, f"{name}.p_WA"), _point(p_WB, f"{name}.p_WB")
    length = float(np.linalg.norm(p_WB - p_WA))
    if length == 0.0:
        raise ValueError(f"{name}: both ends are at {p_WA}; they must differ. Use a Sphere.")
    return p_WA, (p_WB - p_WA) / length, length
