"""The exact distance field of shapes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from splatpilot import _native
from splatpilot.systems.collision.distance_field import FieldSample, FieldState
from splatpilot.systems.collision.shapes import Shape, as_point, shape_rows


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
