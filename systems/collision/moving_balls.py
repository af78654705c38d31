"""Balls that move, and the distance fields that they are part of, instant by instant."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from splatpilot.systems.collision.distance_field import (
    DistanceField,
    Distances,
    FieldSample,
    FieldState,
)


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
