"""Gaussians that show a capture before it is reconstructed."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, depth_points

_MAX_POINTS, _MAX_GAUSSIANS = 2_000_000, 200_000
_SPREAD = 0.6  # standard deviation of a Gaussian over the distance to its neighbors


def capture_gaussians(capture: Capture, frames: Sequence[int]) -> GaussianScene | None:
    """Returns round Gaussians at the measured depth of some frames or, without depth, at the points
    of the registration; None without either."""
    if capture.has_depth:
        # A grid of pixels of each frame.
        pixels = len(frames) * capture.width * capture.height
        step = max(1, int(np.ceil(np.sqrt(pixels / _MAX_POINTS))))
        parts = []
        for i in Progress(frames, "reading depth", unit="frame", delay=2.0):
            frame = capture.frame(i)
            p_CQ, rows, columns = depth_points(frame.K, frame.depth, step)
            p_WQ = frame.X_WC.multiply(p_CQ.T).T
            parts.append(np.column_stack([p_WQ, frame.image[rows, columns] / 255]))
        points, colors = np.split(np.concatenate(parts), 2, axis=1)
    elif capture.points is not None:
        points, colors = capture.points.p_WQ, capture.points.colors
    else:
        return None
    if len(points) < 2:
        return None
    kept = _thin(points)
    points, colors = points[kept], colors[kept]
    distances, _ = KDTree(points).query(points, k=2)
    # A point far from others is not larger than they are.
    size = np.minimum(distances[:, 1], 4 * np.median(distances[:, 1])) + 1e-6
    return GaussianScene.from_colors(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        _SPREAD * size[:, None].repeat(3, axis=1),
        np.full(len(points), 0.95),
        colors,
    )


def _thin(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns the first point in each cell of the finest grid with few occupied cells."""
    lower = points.min(axis=0)
    # Few points far away must not make the cells large.
    extent = float(np.percentile(np.ptp(points, axis=0), 50)) or 1.0
    edge = extent / 4096
    while True:
        cells = np.floor((points - lower) / edge).astype(np.int64)
        _, first = np.unique((cells[:, 0] << 42) ^ (cells[:, 1] << 21) ^ cells[:, 2], True)
        if len(first) <= _MAX_GAUSSIANS:
            return np.sort(first)
        edge *= 1.3
