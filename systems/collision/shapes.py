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
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform


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
