"""Comparison of what two frames of a capture see: depth, contrast and colors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from splatpilot.training.captures.capture import (
    Capture,
    CaptureFrame,
    back_project,
    depth_points,
    project_points,
)

WIDTH = 320
"""[px] Approximate width of compared images, to which lengths in pixels below refer."""
REACH = 0.08
"""[-] Relative difference of depth up to which two frames can show the same surface, and maximum
change of its inverse depth from one pixel to the next."""
_NUM_POINTS, _MIN_POINTS = 1000, 50
"""Maximum compared points per frame, and minimum per pair."""
_FINE, _COARSE = 1.5, 10.0
"""[px] Brightness is blurred by the first, to be smooth over steps, and divided by what the second
leaves: exposure and vignetting cancel in the ratio."""
_BLACK = 0.05
"""Added to the divisor of brightness (0 to 1)."""
_AROUND = np.ones((5, 5), np.uint8)

_COLOR_POINTS = 3000
"""Approximate number of pixels per image whose colors are compared."""
_BLUR = 1.5  # [px]
_SAME_SURFACE = 0.03
_MIN_PIXELS = 300
_MIN_GAIN = 0.6
"""Maximum fraction of the disagreement that another color camera may leave to be accepted."""
_NEGLIGIBLE, _MAX_DISAGREEMENT = 0.01, 0.3
"""Disagreement up to which no other color camera is searched, and above which colors are wrong.
It is 0.02 to 0.04 in captures of real cameras, and 0.11 if one is wrongly read as registered."""
_MIN_SHIFT, _MIN_LOG_ZOOM = 0.008, 0.015
_READING_POINTS = 5000
"""Approximate number of pixels per image whose depth is carried into another."""
_MIN_INSIDE = 0.1
"""Fraction of points that must fall onto measured depth for a reading to count."""


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """Depth and contrast of a frame."""

    K: NDArray[np.float64]  # (3, 3) [px]
    inverse_depth: NDArray[np.float32]
    """(H, W) [1/m]; 0 where it is unknown or not of one surface all around."""
    contrast: NDArray[np.float32]  # (H, W), brightness relative to its neighborhood
    p_CQ: NDArray[np.float64]  # (n, 3) [m], points that it sees
    point_contrast: NDArray[np.float64]  # (n,), of these

    @classmethod
    def of(cls, frame: CaptureFrame) -> "ComparedFrame":
        """Prepares a frame that is about `WIDTH` wide."""
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0).astype(np.float32)
        lower, upper = cv2.erode(depth, _AROUND), cv2.dilate(depth, _AROUND)
        surface = (lower > 0) & (upper < (1 + REACH) * lower)
        # On a plane it is linear in the pixel coordinates, and a blur preserves it.
        inverse = cv2.GaussianBlur(1 / np.where(depth > 0, depth, 1), _AROUND.shape, 0)
        inverse = np.where(surface, inverse, 0).astype(np.float32)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        fine, coarse = (cv2.GaussianBlur(gray, (0, 0), sigma) for sigma in (_FINE, _COARSE))
        contrast = (fine / (coarse + _BLACK)).astype(np.float32)
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(surface))[:_NUM_POINTS]
        rows, columns = np.divmod(chosen, depth.shape[1])
        z = 1 / inverse.flat[chosen].astype(np.float64)
        p_CQ = back_project(frame.K, columns + 0.5, rows + 0.5, z)
        return cls(frame.K, inverse, contrast, p_CQ, contrast.flat[chosen].astype(np.float64))

    def sees(
        self, p_CQ: NDArray[np.float64], reach: float = REACH
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Returns which of the points (n, 3) are on surfaces that it sees, up to a relative
        difference of depth; the image coordinates (2, n) of all; and its inverse depth there with
        derivatives (3, n)."""
        z = p_CQ[:, 2].clip(min=1e-3)
        u = np.array([self.K[k, k] * p_CQ[:, k] / z + self.K[k, 2] for k in (0, 1)])
        inverse = _sample(self.inverse_depth, u)
        # Next to unknown depth it falls to zero.
        steep = np.abs(inverse[1:]).max(axis=0) > REACH * inverse[0]
        same = np.abs(inverse[0] * p_CQ[:, 2] - 1) < reach
        return (inverse[0] > 0) & ~steep & same, u, inverse


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences of two frames at points that both see."""

    residuals: NDArray[np.float64]
    """(2, n): e = w(u) q_z - 1, the relative difference of depth of a point that one frame sees and
    that is at q in the other, in the pixel u, of inverse depth w(u); and c(u) - c, of contrast."""
    derivatives: NDArray[np.float64]
    """(2, n, 12), by small rotations [rad] of one frame about its center, its translation [m], and
    those of the other, all in the axes of the world."""


def compare_frames(
    one: ComparedFrame,
    other: ComparedFrame,
    X_WC: RigidTransform,
    X_WC_other: RigidTransform,
    reach: float,
) -> Comparison | None:
    """Compares the points of one frame with what another sees there, see `ComparedFrame.sees`; None
    if fewer than fifty are on surfaces that it sees."""
    R, p = X_WC_other.rotation().matrix(), X_WC_other.translation()
    p_WQ = one.p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
    q = (p_WQ - p) @ R
    same, u, inverse = other.sees(q, reach)
    if same.sum() < _MIN_POINTS:
        return None
    p_WQ, q, u, inverse = p_WQ[same], q[same], u[:, same], inverse[:, same]
    contrast = _sample(other.contrast, u)
    residuals = np.array([inverse[0] * q[:, 2] - 1, contrast[0] - one.point_contrast[same]])
    # A plane has w = m . ray, so that e = m . q - 1.
    f, c = np.diag(other.K)[:2, None], other.K[:2, 2, None]
    w_x, w_y = inverse[1:] * f
    x, y = (u - c) / f
    c_x, c_y = contrast[1:] * f / q[:, 2]
    by_q = np.array([[w_x, w_y, inverse[0] - x * w_x - y * w_y], [c_x, c_y, -x * c_x - y * c_y]])
    by_p_WQ = by_q.transpose(0, 2, 1) @ R.T  # (2, n, 3)
    turn, turn_other = (np.cross(p_WQ - center, by_p_WQ) for center in (X_WC.translation(), p))
    return Comparison(residuals, np.concatenate([turn, by_p_WQ, -turn_other, -by_p_WQ], axis=2))


def _sample(image: NDArray[np.float32], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns an image and its derivatives [1/px] along rows and columns, (3, n), at the image
    coordinates u (2, n); zero outside."""
    x, y = (u - 0.5).clip(-9, 1e4).astype(np.float32)[:, None]
    values = [
        cv2.remap(image, x + a, y + b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    center, right, left, below, above = np.array(values, dtype=np.float64)
    return np.array([center, (right - left) / 2, (below - above) / 2])


@dataclass(frozen=True)
class ColorFit:
    """Disagreement of colors, 1 - their correlation, with the color camera as read and the one that
    fits best."""

    cost: float
    best_cost: float
    focal_length: float  # [px], that fits best
    p_DC: tuple[float, float]  # [m], right and down from the depth camera, that fits best
    mistake: str

    def __str__(self) -> str:
        x, y = self.p_DC
        return (
            f"{self.cost:12.4f}  as it was read\n{self.best_cost:12.4f}  best: color focal length "
            f"{self.focal_length:.0f} px, color camera at ({x:+.3f}, {y:+.3f}, 0) m in the depth "
            "camera"
        )


@dataclass(frozen=True, eq=False)
class _ColoredPair:
    p_DQs: tuple[NDArray[np.float64], NDArray[np.float64]]  # (3, n) [m] each
    images: tuple[NDArray[np.float32], NDArray[np.float32]]
    """(H, W) each, luminance, NaN in invalid pixels."""


def fit_color_camera(capture: Capture, pairs: Sequence[tuple[int, int]]) -> ColorFit | None:
    """Fits the focal length and position of the color camera, its axes parallel to depth's.

    A point on a surface has about the same luminance in two frames; a wrong color camera samples
    other points, which differ from frame to frame. Correlation does not depend on exposure.

    Args:
        pairs: indices of frames to compare.

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
        X = RigidTransform(X_DC.rotation(), X_DC.translation() + np.array([x[1], x[2], 0]))
        correlations = [_correlation(pair, K, X) for pair in colored]
        found = [1 - each for each in correlations if each is not None]
        return float(np.mean(found)) if len(found) > len(colored) / 2 else 2.0

    as_read = cost(np.zeros(3))
    simplex = np.concatenate([np.zeros((1, 3)), np.diag([-0.1, 0.03, 0.03])])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-5, "maxfev": 90}
    fit = minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)
    focal_length = float(capture.K[0, 0] * np.exp(fit.x[0]))
    x, y = (X_DC.translation()[:2] + fit.x[1:]).tolist()
    mistake = ""
    moved = np.linalg.norm(fit.x[1:]) > _MIN_SHIFT or abs(fit.x[0]) > _MIN_LOG_ZOOM
    if as_read > _NEGLIGIBLE and fit.fun < _MIN_GAIN * as_read and moved:
        mistake = (
            "most likely color and depth are not registered: a color camera of focal length "
            f"{focal_length:.0f} px at ({x:+.3f}, {y:+.3f}, 0) m in the depth camera leaves "
            f"{fit.fun:.3f} of disagreement between colors instead of {as_read:.3f}"
        )
    elif as_read > _MAX_DISAGREEMENT:
        mistake = (
            f"colors do not follow depth: 1 - their correlation between frames is {as_read:.2f}, "
            f"at most {_MAX_DISAGREEMENT} is plausible; intrinsics may be those of another camera"
        )
    return ColorFit(as_read, float(fit.fun), focal_length, (x, y), mistake)


def _grid_step(image: NDArray, count: int) -> int:
    """Returns the step along both axes that leaves about `count` pixels."""
    return max(1, round((image.size / count) ** 0.5))


def _color_pair(
    capture: Capture, K_D: NDArray[np.float64], X_DC: RigidTransform, i: int, j: int
) -> _ColoredPair | None:
    """Returns the points of frame i that frame j sees too, in both depth cameras."""
    a, b = capture.measured_depth(i), capture.measured_depth(j)
    if a is None or b is None:
        return None
    p_DQ = depth_points(K_D, a, _grid_step(a, _COLOR_POINTS))[0].T
    X_WDs = [capture.X_WCs[k] @ X_DC.inverse() for k in (i, j)]
    q = (X_WDs[1].inverse() @ X_WDs[0]).multiply(p_DQ)
    seen, rows, columns = project_points(K_D, q.T, b.shape[1], b.shape[0])
    seen[seen] = np.abs(b[rows, columns] - q[2][seen]) < _SAME_SURFACE * q[2][seen]
    if seen.sum() < _MIN_PIXELS:
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
    """Returns the correlation of the luminance of a pair, None if too few points are inside both
    images."""
    samples = []
    for p_DQ, image in zip(pair.p_DQs, pair.images, strict=True):
        x, y, z = X_DC.inverse().multiply(p_DQ)
        u = (K[0, 0] * x / z + K[0, 2] - 0.5).astype(np.float32)
        v = (K[1, 1] * y / z + K[1, 2] - 0.5).astype(np.float32)
        sampled = cv2.remap(image, u[None], v[None], cv2.INTER_LINEAR, borderValue=-1.0)[0]
        height, width = image.shape
        inside = (z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        samples.append((sampled, inside & np.isfinite(sampled)))
    (a, inside_a), (b, inside_b) = samples
    both = inside_a & inside_b
    if both.sum() < _MIN_PIXELS or a[both].std() == 0 or b[both].std() == 0:
        return None
    return float(np.corrcoef(a[both], b[both])[0, 1])


@dataclass(frozen=True, eq=False)
class FramePair:
    """Points of one frame, and another frame that should see them."""

    pixels: NDArray[np.float64]  # (2, n) [px], image coordinates in the first frame's depth
    depth: NDArray[np.float64]  # (n,) [m]
    X_FBs: tuple[RigidTransform, RigidTransform]  # as the files have them, of the depth camera
    other: NDArray[np.float32]  # (H, W) [m], depth of the second frame
    frames: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Reading:
    """One interpretation of the files of a capture."""

    name: str
    K: NDArray[np.float64]  # (3, 3) [px], of the depth camera
    R_BC: RotationMatrix
    pose: Callable[[RigidTransform], RigidTransform] = lambda X_FB: X_FB
    factor: float = 1.0
    """Scale of depth."""
    is_range: bool = False
    """Whether the distance from the camera is stored instead of depth along its axis."""


@dataclass(frozen=True)
class ReadingFit:
    """Agreement of depth between frames under a reading."""

    name: str
    error: float
    """Median of |z' / z - 1|, depth z carried into another frame and z' found there; infinite if
    the frames hardly overlap."""
    inside: float
    """The fraction of points that fall onto measured depth in the other frame."""


def initial_reading(capture: Capture) -> Reading:
    """Returns the reading of the capture as it was opened."""
    R_BC = capture.axes.R_BC if capture.axes is not None else RotationMatrix()
    K = capture.depth_camera.K if capture.depth_camera is not None else capture.K
    return Reading("as it was read", K, R_BC)


def choose_pairs(capture: Capture, count: int) -> list[FramePair]:
    """Chooses frames spread over the capture, each with a later one that sees it differently.

    That is at most 16 frames later: the first whose camera has moved by an eighth of the median
    depth or rotated by ten degrees, but by no more than 45, else the last.
    """
    axes, camera = capture.axes, capture.depth_camera
    X_CD = camera.X_CD if camera is not None else RigidTransform()
    X_WF = RigidTransform(axes.R_WF) if axes is not None else RigidTransform()
    X_BC = RigidTransform(axes.R_BC) if axes is not None else RigidTransform()
    X_FW = X_WF.inverse() @ RigidTransform(capture.origin)
    pairs = []
    for i in np.unique(np.linspace(0, len(capture) - 2, count).astype(int)).tolist():
        depth = capture.measured_depth(i)
        if depth is None:
            continue
        step = _grid_step(depth, _READING_POINTS)
        p_CQ, rows, columns = depth_points(capture.K, depth, step, start=step // 2)
        if not len(p_CQ):
            continue
        j = _later_frame(capture, i, float(np.median(p_CQ[:, 2])))
        other = capture.measured_depth(j) if j is not None else None
        if j is None or other is None:
            continue
        X_FBs = tuple(X_FW @ capture.X_WCs[k] @ X_CD @ X_BC.inverse() for k in (i, j))
        pixels = np.array([columns + 0.5, rows + 0.5], dtype=np.float64)
        pairs.append(FramePair(pixels, p_CQ[:, 2], X_FBs, other, (i, j)))
    return pairs


def _later_frame(capture: Capture, i: int, depth: float) -> int | None:
    j = None
    for j in range(i + 1, min(i + 17, len(capture))):
        X = capture.X_WCs[i].inverse() @ capture.X_WCs[j]
        angle = X.rotation().ToAngleAxis().angle()
        moved = np.linalg.norm(X.translation()) > depth / 8 or abs(angle) > np.deg2rad(10)
        if moved and abs(angle) < np.deg2rad(45):
            break
    return j


def measure_reading(reading: Reading, pairs: Sequence[FramePair]) -> ReadingFit:
    """Measures a reading on pairs of frames."""
    error = np.concatenate([_relative_errors(reading, pair) for pair in pairs])
    inside = len(error) / sum(len(pair.depth) for pair in pairs)
    median = float(np.median(error)) if inside >= _MIN_INSIDE else np.inf
    return ReadingFit(reading.name, median, inside)


def _relative_errors(reading: Reading, pair: FramePair) -> NDArray[np.float64]:
    def stretch(u: NDArray, v: NDArray) -> NDArray[np.float64]:
        """Returns the distance of points at depth 1."""
        return np.linalg.norm(back_project(reading.K, u, v, np.ones(u.shape)), axis=-1)

    z = reading.factor * pair.depth
    if reading.is_range:
        z = z / stretch(*pair.pixels)
    R_BC = RigidTransform(reading.R_BC)
    a, b = (reading.pose(X_FB) @ R_BC for X_FB in pair.X_FBs)
    u, v = pair.pixels
    p_CQ = (b.inverse() @ a).multiply(back_project(reading.K, u, v, z).T).T
    height, width = pair.other.shape
    hit, rows, columns = project_points(reading.K, p_CQ, width, height)
    found = reading.factor * pair.other[rows, columns].astype(np.float64)
    if reading.is_range:
        found /= stretch(columns + 0.5, rows + 0.5)
    known = (found > 0) & np.isfinite(found)
    return np.minimum(np.abs(found[known] / p_CQ[hit, 2][known] - 1), 1.0)
