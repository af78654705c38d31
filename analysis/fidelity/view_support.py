"""How much of a view was seen by the cameras that a scene was made from, without any truth."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.lens import back_project
from splatpilot.training.reconstruction.measures import SceneRenderer

_WIDTH = 48  # [px] of the views that are compared
_NEAREST = 16  # cameras that are asked
_DEPTH_TOLERANCE = 0.05  # relative difference of depth on the same surface
_MAX_ANGLE = np.cos(np.deg2rad(45))  # between the rays of both cameras to a point
_MAX_RATIO = 2.0  # of the distances from which both cameras see a point


class ViewSupport:
    """The share of a view's pixels whose surface a camera of the capture saw much the same way.

    A camera did if it has the point in its image, at the depth that the scene has for it there (5 %
    apart at most: nothing stands before it), from a direction at most 45 degrees off, and not from
    more than twice as far. The nearest 16 cameras are asked. Pixels that show nothing count as not
    seen.

    Args:
        renderer: of the scene.
        K, width, height: the camera [px].
        X_WCs: poses of the cameras that the scene was made from.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        K: NDArray,
        width: int,
        height: int,
        X_WCs: Sequence[RigidTransform],
    ):
        shrunk = _WIDTH / width
        self._K = K.copy()
        self._K[:2] *= shrunk
        self._width, self._height = _WIDTH, max(1, round(height * shrunk))
        self._renderer = renderer
        self._X_WCs = list(X_WCs)
        self._p_WCs = np.array([X_WC.translation() for X_WC in X_WCs])  # (n, 3)
        self._depths: dict[int, NDArray] = {}

    def of(self, X_WC: RigidTransform) -> float:
        """Returns the share, 0 to 1, for the camera at `X_WC`."""
        depth = self._render(X_WC)
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        p_WQ = X_WC.multiply(back_project(self._K, columns + 0.5, rows + 0.5, z).T)  # (3, m)
        ray = p_WQ - X_WC.translation()[:, None]
        distance = np.linalg.norm(ray, axis=0)
        unseen = np.arange(len(z))
        for i in self._nearest(X_WC.translation()):
            sees = self._sees(i, p_WQ[:, unseen], ray[:, unseen], distance[unseen])
            unseen = unseen[~sees]
        return float((len(z) - len(unseen)) / depth.size)

    def distance(self, p_WC: ArrayLike) -> float:
        """Returns the distance to the nearest camera [m]."""
        return float(np.linalg.norm(self._p_WCs - np.asarray(p_WC), axis=1).min())

    def _nearest(self, p_WC: NDArray) -> NDArray[np.intp]:
        return np.argsort(np.linalg.norm(self._p_WCs - p_WC, axis=1), kind="stable")[:_NEAREST]

    def _sees(self, i: int, p_WQ: NDArray, ray: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """Tells which of the points (3, m) camera i saw like a camera with these rays to them."""
        x, y, z = self._X_WCs[i].inverse().multiply(p_WQ)
        in_front = np.maximum(z, 1e-6)
        column = np.floor(self._K[0, 0] * x / in_front + self._K[0, 2])
        row = np.floor(self._K[1, 1] * y / in_front + self._K[1, 2])
        inside = (
            (z > 0) & (column >= 0) & (column < self._width) & (row >= 0) & (row < self._height)
        )
        if i not in self._depths:
            self._depths[i] = self._render(self._X_WCs[i])
        column, row = (np.where(inside, index, 0).astype(int) for index in (column, row))
        same = np.abs(self._depths[i][row, column] - z) <= _DEPTH_TOLERANCE * np.maximum(z, 0)
        own_ray = p_WQ - self._p_WCs[i][:, None]
        own_distance = np.linalg.norm(own_ray, axis=0)
        cosine = (ray * own_ray).sum(axis=0) / np.maximum(distance * own_distance, 1e-12)
        near = own_distance <= _MAX_RATIO * distance
        return inside & same & near & (cosine >= _MAX_ANGLE)

    def _render(self, X_WC: RigidTransform) -> NDArray[np.float32]:
        return self._renderer.render(self._K, self._width, self._height, X_WC).depth
