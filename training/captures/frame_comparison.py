"""How depth and brightness of what two frames see differ, and how that changes with their poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from splatpilot.training.captures.capture import Capture, CaptureFrame, back_project

WIDTH = 320
"""[px] That images to be compared are about wide: what is in pixels below is of such."""
REACH = 0.08
"""[-] Relative difference of depth up to which two frames can show the same, and change of inverse
depth from one pixel to the next that a surface can have."""
_POINTS, _FEWEST = 1000, 50
"""Of each frame that are compared, at most; and of a pair at least."""
_FINE, _COARSE = 1.5, 10.0
"""[px] Brightness is blurred by the first, so that it is smooth over the steps that are made, and
divided by what the second leaves: neither exposure nor the lens's dark corners are in the ratio."""
_BLACK = 0.05
"""Added to what brightness (0 to 1) is divided by."""

_AROUND = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """What of a frame is compared."""

    K: NDArray[np.float64]  # (3, 3) [px]
    inverse_depth: NDArray[np.float32]
    """(H, W) [1/m]; 0 where it is not known, or not of one surface all around."""
    contrast: NDArray[np.float32]  # (H, W), brightness relative to what is around
    p_CQ: NDArray[np.float64]  # (n, 3) [m], points that it sees
    point_contrast: NDArray[np.float64]  # (n,), of these

    @classmethod
    def of(cls, frame: CaptureFrame) -> "ComparedFrame":
        """Prepares a frame that is about `WIDTH` wide."""
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0).astype(np.float32)
        least, most = cv2.erode(depth, _AROUND), cv2.dilate(depth, _AROUND)
        surface = (least > 0) & (most < (1 + REACH) * least)
        # That of a plane is linear in the pixel coordinates: a blur leaves it as it is.
        inverse = cv2.GaussianBlur(1 / np.where(depth > 0, depth, 1), _AROUND.shape, 0)
        inverse = np.where(surface, inverse, 0).astype(np.float32)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        fine, coarse = (cv2.GaussianBlur(gray, (0, 0), sigma) for sigma in (_FINE, _COARSE))
        contrast = (fine / (coarse + _BLACK)).astype(np.float32)
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(surface))[:_POINTS]
        rows, columns = np.divmod(chosen, depth.shape[1])
        z = 1 / inverse.flat[chosen].astype(np.float64)
        p_CQ = back_project(frame.K, columns + 0.5, rows + 0.5, z)
        return cls(frame.K, inverse, contrast, p_CQ, contrast.flat[chosen].astype(np.float64))

    def sees(
        self, p_CQ: NDArray[np.float64], reach: float = REACH
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Returns which of the points (n, 3) are on the surfaces that it sees, up to a relative
        difference of depth; the image coordinates (2, n) of all; and its inverse depth there, see
        `_at`."""
        z = p_CQ[:, 2].clip(min=1e-3)
        u = np.array([self.K[k, k] * p_CQ[:, k] / z + self.K[k, 2] for k in (0, 1)])
        inverse = _at(self.inverse_depth, u)
        # Beside what is not known it falls to zero.
        steep = np.abs(inverse[1:]).max(axis=0) > REACH * inverse[0]
        same = np.abs(inverse[0] * p_CQ[:, 2] - 1) < reach
        return (inverse[0] > 0) & ~steep & same, u, inverse


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two frames, where both see the same."""

    residuals: NDArray[np.float64]
    """(2, n): e = w(u) q_z - 1, the relative difference of depth of a point that one sees and the
    other has at q, in the pixel u, with the inverse depth w(u); and c(u) - c, that of contrast."""
    derivatives: NDArray[np.float64]
    """(2, n, 12), by small turns [rad] of one frame about its centre, its steps [m], and those of
    the other, all in the axes of the world."""


def compare_frames(
    one: ComparedFrame,
    other: ComparedFrame,
    X_WC: RigidTransform,
    X_WC_other: RigidTransform,
    reach: float,
) -> Comparison | None:
    """Returns how the points of one frame differ from what the other sees there; None where less
    than fifty are on surfaces that it sees, see `ComparedFrame.sees`."""
    R, p = X_WC_other.rotation().matrix(), X_WC_other.translation()
    p_WQ = one.p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
    q = (p_WQ - p) @ R
    same, u, inverse = other.sees(q, reach)
    if same.sum() < _FEWEST:
        return None
    p_WQ, q, u, inverse = p_WQ[same], q[same], u[:, same], inverse[:, same]
    contrast = _at(other.contrast, u)
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


def _at(image: NDArray[np.float32], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns an image and its derivatives [1/px] along rows and columns, (3, n), at the image
    coordinates u (2, n); zero outside."""
    x, y = (u - 0.5).clip(-9, 1e4).astype(np.float32)[:, None]
    values = [
        cv2.remap(image, x + a, y + b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    center, right, left, below, above = np.array(values, dtype=np.float64)
    return np.array([center, (right - left) / 2, (below - above) / 2])


# Whether colour and depth come from one camera, told from how colours agree between frames.
#
# A point on a surface has about the same colour in two frames. Depth says where it is in both; a
# wrong idea of the colour camera samples the wrong colours, and ones that change from frame to
# frame. The measure is 1 - the correlation of luminance between frames, which exposure does not
# change, averaged over pairs.


_MAX_REGISTRATION_POINTS = 3000
"""About how many pixels of an image are compared."""
_BLUR = 1.5  # [px]
_SAME_SURFACE = 0.03
_MIN_PIXELS = 300
_MIN_GAIN = 0.6
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
    if as_read > _NEGLIGIBLE and fit.fun < _MIN_GAIN * as_read and moved:
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
    step = grid_step(a, _MAX_REGISTRATION_POINTS)
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
    if both.sum() < _MIN_PIXELS or a[both].std() == 0 or b[both].std() == 0:
        return None
    return float(np.corrcoef(a[both], b[both])[0, 1])


# How well depth of one frame, carried into another, agrees with the depth that stands there.
#
# With the right reading of a capture's files both are the same surface. The measure is the median
# of |z' / z - 1| over points of many pairs of frames, z carried over and z' found.


_MAX_POINTS = 5000
"""About how many pixels of an image are carried over."""
_LEAST_INSIDE = 0.1
"""Of the points, the fraction that must fall onto measured depth for a reading to count."""


@dataclass(frozen=True, eq=False)
class FramePair:
    """Points of one frame, and another frame that should see them."""

    pixels: NDArray[np.float64]  # (2, n) [px], image coordinates in the first frame's depth
    depth: NDArray[np.float64]  # (n,) [m]
    X_FBs: tuple[RigidTransform, RigidTransform]  # as the files have them, of the depth camera
    other: NDArray[np.float32]  # (H, W) [m], depth of the second frame
    frames: tuple[int, int]


def _same(X_FB: RigidTransform) -> RigidTransform:
    return X_FB


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to understand the files of a capture."""

    name: str
    K: NDArray[np.float64]  # (3, 3) [px], of the depth camera
    R_BC: RotationMatrix
    pose: Callable[[RigidTransform], RigidTransform] = _same
    factor: float = 1.0
    """Times what depth is taken to be."""
    is_range: bool = False
    """Whether what is stored is the distance from the camera, not depth along its axis."""


@dataclass(frozen=True)
class ReadingFit:
    """How well a reading fits."""

    name: str
    error: float
    """Median relative error of depth; infinite if the frames hardly overlap."""
    inside: float
    """The fraction of points that fall onto measured depth in the other frame."""


def reading_of(capture: Capture) -> Reading:
    """Returns the reading of the capture as it was opened."""
    R_BC = capture.axes.R_BC if capture.axes is not None else RotationMatrix()
    K = capture.depth_camera.K if capture.depth_camera is not None else capture.K
    return Reading("as it was read", K, R_BC)


def choose_pairs(capture: Capture, count: int) -> list[FramePair]:
    """Chooses frames spread over the capture, each with a later one that sees it differently.

    Later means by at most 16 frames: the first whose camera has moved by an eighth of the median
    depth or turned by ten degrees, but by no more than 45, and the last if none has.
    """
    X_CD = capture.depth_camera.X_CD if capture.depth_camera is not None else RigidTransform()
    axes = capture.axes
    R_WF = RigidTransform(axes.R_WF) if axes is not None else RigidTransform()
    R_BC = RigidTransform(axes.R_BC) if axes is not None else RigidTransform()

    X_OW = RigidTransform(capture.origin)

    def X_FB(i: int) -> RigidTransform:
        return R_WF.inverse() @ X_OW @ capture.X_WCs[i] @ X_CD @ R_BC.inverse()

    pairs = []
    for i in np.unique(np.linspace(0, len(capture) - 2, count).astype(int)).tolist():
        depth = capture.measured_depth(i)
        if depth is None:
            continue
        step = grid_step(depth, _MAX_POINTS)
        rows, columns = np.mgrid[
            step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step
        ]
        z = depth[rows, columns].astype(np.float64)
        known = (z > 0) & np.isfinite(z)
        if not known.any():
            continue
        j = _partner(capture, i, float(np.median(z[known])))
        other = capture.measured_depth(j) if j is not None else None
        if j is None or other is None:
            continue
        pixels = np.stack([columns[known] + 0.5, rows[known] + 0.5])
        pairs.append(FramePair(pixels, z[known], (X_FB(i), X_FB(j)), other, (i, j)))
    return pairs


def _partner(capture: Capture, i: int, depth: float) -> int | None:
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
    errors, total = [], 0
    for pair in pairs:
        error = _relative_errors(reading, pair)
        errors.append(error)
        total += len(pair.depth)
    error = np.concatenate(errors)
    inside = len(error) / total
    if inside < _LEAST_INSIDE:
        return ReadingFit(reading.name, np.inf, inside)
    return ReadingFit(reading.name, float(np.median(error)), inside)


def _relative_errors(reading: Reading, pair: FramePair) -> NDArray[np.float64]:
    f, c = np.diag(reading.K)[:2], reading.K[:2, 2]
    u, v = pair.pixels
    rays = back_project(reading.K, u, v, np.ones_like(u)).T
    z = reading.factor * pair.depth
    if reading.is_range:
        z = z / np.linalg.norm(rays, axis=0)
    R_BC = RigidTransform(reading.R_BC)
    a, b = (reading.pose(X_FB) @ R_BC for X_FB in pair.X_FBs)
    x, y, z = (b.inverse() @ a).multiply(z * rays)
    front = z > 0
    x, y, z = x[front] / z[front], y[front] / z[front], z[front]
    height, width = pair.other.shape
    u = np.floor(f[0] * x + c[0])
    v = np.floor(f[1] * y + c[1])
    hit = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v, z = u[hit].astype(np.intp), v[hit].astype(np.intp), z[hit]
    found = reading.factor * pair.other[v, u].astype(np.float64)
    if reading.is_range:
        found /= np.hypot(1, np.hypot((u + 0.5 - c[0]) / f[0], (v + 0.5 - c[1]) / f[1]))
    known = (found > 0) & np.isfinite(found)
    return np.minimum(np.abs(found[known] / z[known] - 1), 1.0)
