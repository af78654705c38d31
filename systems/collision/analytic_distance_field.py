"""The exact distance field of shapes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from splatpilot.systems.collision.distance_field import FieldSample, FieldState
from splatpilot.systems.collision.shapes import Shape, as_point


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
        self.lower_W = as_point(lower_W, "AnalyticDistanceField.lower_W").copy()
        self.upper_W = as_point(upper_W, "AnalyticDistanceField.upper_W").copy()
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
