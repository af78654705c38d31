"""What a capture knows of its place before it is reconstructed, as Gaussians to look at."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from splatpilot.systems.progress import Progress
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.captures.capture import Capture

_MAX_POINTS = 2_000_000
_MAX_GAUSSIANS = 200_000
_SPREAD = 0.6
"""Standard deviation of a Gaussian over the distance to its neighbours."""


def capture_gaussians(capture: Capture, frames: Sequence[int]) -> GaussianScene | None:
    """Returns round Gaussians about the points that are known: measured depth of some frames or,
    without any, those of the registration; None if there are neither.

    Raises:
        OSError, ValueError: if a file cannot be read.
    """
    if capture.has_depth:
        points, colors = _points_from_depth(capture, frames)
    elif capture.points is not None:
        points, colors = capture.points.p_WQ, capture.points.colors
    else:
        return None
    if len(points) < 2:
        return None
    kept = _thinned(points, _MAX_GAUSSIANS)
    points, colors = points[kept], colors[kept]
    distances, _ = KDTree(points).query(points, k=2)
    # A point that stands alone is no larger than the others are.
    size = np.minimum(distances[:, 1], 4 * np.median(distances[:, 1])) + 1e-6
    return GaussianScene.from_colors(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        _SPREAD * size[:, None].repeat(3, axis=1),
        np.full(len(points), 0.95),
        colors,
    )


def _points_from_depth(
    capture: Capture, frames: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points p_WQ (N, 3) [m] and colours (N, 3), 0 to 1, of every so many-th pixel."""
    pixels = len(frames) * capture.width * capture.height
    step = max(1, int(np.ceil(np.sqrt(pixels / _MAX_POINTS))))
    points, colors = [], []
    for i in Progress(frames, "reading depth", unit="frame", delay=2.0):
        frame = capture.frame(i)
        depth = frame.depth[::step, ::step]
        rows, columns = np.nonzero((depth > 0) & np.isfinite(depth))
        p_CQ = frame.back_project(step * columns + 0.5, step * rows + 0.5, depth[rows, columns])
        points.append(frame.X_WC.multiply(p_CQ.T.astype(float)).T)
        colors.append(frame.image[::step, ::step][rows, columns] / 255)
    return np.concatenate(points), np.concatenate(colors)


def _thinned(points: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """The first point in each cell of the finest grid in which at most `count` cells have one."""
    lower = points.min(axis=0)
    # Few points far away must not make the cells large.
    extent = float(np.percentile(np.ptp(points, axis=0), 50)) or 1.0
    edge = extent / 4096
    while True:
        cells = np.floor((points - lower) / edge).astype(np.int64)
        _, first = np.unique((cells[:, 0] << 42) ^ (cells[:, 1] << 21) ^ cells[:, 2], True)
        if len(first) <= count:
            return np.sort(first)
        edge *= 1.3
