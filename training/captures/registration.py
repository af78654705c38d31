"""Whether colour and depth come from one camera, told from how colours agree between frames.

A point on a surface has about the same colour in two frames. Depth says where it is in both; a
wrong idea of the colour camera samples the wrong colours, and ones that change from frame to frame.
The measure is 1 - the correlation of luminance between frames, which exposure does not change,
averaged over pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.optimize import minimize

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.lens import back_project

_POINTS = 3000
"""About how many pixels of an image are compared."""
_BLUR = 1.5  # [px]
_SAME_SURFACE = 0.03
_FEWEST = 300
_BETTER = 0.6
"""What fraction of the disagreement another colour camera must leave to be believed."""
_NEGLIGIBLE, _LARGEST = 0.01, 0.3
"""Disagreement below which no other color camera is looked for, and above which none is believed.
It is 0.02 to 0.04 in captures of real cameras, and 0.11 where one is wrongly read as registered."""
_SHORTEST = 0.008
_SMALLEST = 0.015


@dataclass(frozen=True)
class ColorFit:
    """How colours agree with the colour camera as read, and with the one that fits best."""

    cost: float
    best_cost: float
    focal_length: float  # [px], that fits best
    p_DC: tuple[float, float]  # [m], right and down from the depth camera, that fits best
    mistake: str

    def __str__(self) -> str:
        x, y = self.p_DC
        return (
            f"{self.cost:12.4f}  as it was read\n{self.best_cost:12.4f}  best: colour focal length "
            f"{self.focal_length:.0f} px, colour camera at ({x:+.3f}, {y:+.3f}, 0) m in the depth "
            "camera"
        )


@dataclass(frozen=True, eq=False)
class _ColoredPair:
    p_DQs: tuple[NDArray[np.float64], NDArray[np.float64]]  # (3, n) [m] each
    images: tuple[NDArray[np.float32], NDArray[np.float32]]
    """(H, W) each, luminance, NaN in invalid pixels."""


def grid_step(image: NDArray, count: int) -> int:
    """Returns every how manieth pixel along each axis to take so that about `count` are left."""
    return max(1, round((image.size / count) ** 0.5))


def fit_color_camera(capture: Capture, pairs: Sequence[tuple[int, int]]) -> ColorFit | None:
    """Fits the focal length and position of the colour camera, its axes parallel to depth's.

    Args:
        pairs: numbers of frames to compare.

    Returns:
        The fit, or None if too few points are seen twice.
    """
    depth_camera = capture.depth_camera
    K_D = capture.K if depth_camera is None else depth_camera.K
    X_DC = RigidTransform() if depth_camera is None else depth_camera.X_CD.inverse()
    colored = [pair for i, j in pairs if (pair := _color_pair(capture, K_D, X_DC, i, j))]
    if not colored:
        return None

    def cost(x: NDArray[np.float64]) -> float:
        K = capture.K.copy()
        K[:2, :2] *= np.exp(x[0])
        p = X_DC.translation() + np.array([x[1], x[2], 0])
        found = [
            1 - correlation
            for pair in colored
            if (correlation := _correlation(pair, K, RigidTransform(X_DC.rotation(), p)))
            is not None
        ]
        return float(np.mean(found)) if len(found) > len(colored) / 2 else 2.0

    as_read = cost(np.zeros(3))
    simplex = np.concatenate([np.zeros((1, 3)), np.diag([-0.1, 0.03, 0.03])])
    fit = minimize(
        cost,
        np.zeros(3),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-5, "maxfev": 90},
    )
    focal_length = float(capture.K[0, 0] * np.exp(fit.x[0]))
    x, y = (X_DC.translation()[:2] + fit.x[1:]).tolist()
    mistake = ""
    moved = np.linalg.norm(fit.x[1:]) > _SHORTEST or abs(fit.x[0]) > _SMALLEST
    if as_read > _NEGLIGIBLE and fit.fun < _BETTER * as_read and moved:
        mistake = (
            "most likely colour and depth are not registered: a colour camera of focal length "
            f"{focal_length:.0f} px at ({x:+.3f}, {y:+.3f}, 0) m in the depth camera leaves "
            f"{fit.fun:.3f} of disagreement between colours instead of {as_read:.3f}"
        )
    elif as_read > _LARGEST:
        mistake = (
            f"colors do not follow depth: 1 - their correlation between frames is {as_read:.2f}, "
            f"at most {_LARGEST} is believed; intrinsics may be those of another camera"
        )
    return ColorFit(as_read, float(fit.fun), focal_length, (x, y), mistake)


def _color_pair(
    capture: Capture, K_D: NDArray[np.float64], X_DC: RigidTransform, i: int, j: int
) -> _ColoredPair | None:
    """Returns the points of frame i that frame j sees too, in both depth cameras."""
    a, b = capture.measured_depth(i), capture.measured_depth(j)
    if a is None or b is None:
        return None
    step = grid_step(a, _POINTS)
    rows, columns = np.mgrid[0 : a.shape[0] : step, 0 : a.shape[1] : step]
    z = a[rows, columns].astype(np.float64)
    known = (z > 0) & np.isfinite(z)
    z, rows, columns = z[known], rows[known], columns[known]
    p_DQ = back_project(K_D, columns + 0.5, rows + 0.5, z).T
    X_WDs = [capture.X_WCs[k] @ X_DC.inverse() for k in (i, j)]
    q = (X_WDs[1].inverse() @ X_WDs[0]).multiply(p_DQ)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(K_D[0, 0] * q[0] / q[2] + K_D[0, 2])
        v = np.floor(K_D[1, 1] * q[1] / q[2] + K_D[1, 2])
    seen = (q[2] > 0) & (u >= 0) & (u < b.shape[1]) & (v >= 0) & (v < b.shape[0])
    found = b[v[seen].astype(np.intp), u[seen].astype(np.intp)]
    seen[seen] = np.abs(found - q[2][seen]) < _SAME_SURFACE * q[2][seen]
    if seen.sum() < _FEWEST:
        return None
    return _ColoredPair(
        (p_DQ[:, seen], q[:, seen]), (_luminance(capture, i), _luminance(capture, j))
    )


def _luminance(capture: Capture, i: int) -> NDArray[np.float32]:
    gray = cv2.cvtColor(capture.load_image(i), cv2.COLOR_RGB2GRAY).astype(np.float32)
    valid = np.broadcast_to(capture.load_valid(i), gray.shape)
    sums, weights = (
        cv2.GaussianBlur(each.astype(np.float32), (0, 0), _BLUR) for each in (gray * valid, valid)
    )
    return np.divide(sums, weights, out=np.full_like(gray, np.nan), where=valid)


def _correlation(pair: _ColoredPair, K: NDArray[np.float64], X_DC: RigidTransform) -> float | None:
    """Returns the correlation of the colours of a pair, None if too few are inside both images."""
    samples = []
    for p_DQ, image in zip(pair.p_DQs, pair.images, strict=True):
        x, y, z = X_DC.inverse().multiply(p_DQ)
        u = (K[0, 0] * x / z + K[0, 2] - 0.5).astype(np.float32)
        v = (K[1, 1] * y / z + K[1, 2] - 0.5).astype(np.float32)
        outside = -1.0
        sampled = cv2.remap(image, u[None], v[None], cv2.INTER_LINEAR, borderValue=outside)[0]
        height, width = image.shape
        inside = (z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        samples.append((sampled, inside & np.isfinite(sampled)))
    (a, inside_a), (b, inside_b) = samples
    both = inside_a & inside_b
    if both.sum() < _FEWEST or a[both].std() == 0 or b[both].std() == 0:
        return None
    return float(np.corrcoef(a[both], b[both])[0, 1])
