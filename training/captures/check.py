"""Checks that poses, intrinsics and depth of a capture agree, and finds a likely error if not.

The capture as read, and readings of its files that each undo one known error, are measured on the
same pairs of frames: by depth or, without any, by the epipolar lines of features.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.validation import Config, bounded
from splatpilot.training.captures.capture import (
    Capture,
    back_project,
    depth_points,
    project,
    project_points,
)
from splatpilot.training.captures.capture_config import CaptureConfig, complete_config
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.epipolar import epipolar_errors, match_frames

_BODIES = {
    "optical axes (x right, y down, z forward)": np.eye(3),
    "OpenGL axes (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
    "a north-east-down body (x forward, y right, z down)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "an east-north-up body (x forward, y left, z up)": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}
_WORLDS = {
    "east and north": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "y and z": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "up and down": np.diag([1, -1, -1]),
}
_DEPTH_FACTORS = (0.001, 0.01, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 100.0, 1000.0)
_IMAGE_FACTORS = (0.25, 0.5, 0.75, 4 / 3, 2.0, 4.0)
_MIN_POINTS = 200  # in all pairs together, for a conclusion
_MIN_INSIDE = 0.1  # fraction of points that must fall onto measured depth for a reading to count
_TOLERANCE = 0.02  # median relative error up to which a capture agrees with itself
_NEGLIGIBLE = 0.002  # median error up to which other readings are ignored
_MIN_GAIN = 0.5  # maximum fraction of the error that another reading may leave to be accepted
_DEPTH_POINTS = 5000  # approximate number of pixels per image whose depth is compared

_EPIPOLAR_TOLERANCE = 0.01  # the same of epipolar errors, in focal lengths
_MIN_BEFORE = 0.5  # fraction of points that must lie before both cameras for a reading to count
_ZOOMS = (0.75, 4 / 3)  # other focal lengths that frames must tell from the right one

# The same of colors, whose error is 1 - their correlation between frames: 0.02 to 0.04 in captures
# of real cameras, and 0.11 if one is wrongly read as registered.
_MIN_COLOR_POINTS = 300  # in a pair
_COLOR_TOLERANCE, _COLOR_NEGLIGIBLE, _MIN_COLOR_GAIN = 0.3, 0.01, 0.6
_MIN_SHIFT, _MIN_LOG_ZOOM = 0.008, 0.015  # [m], [-], of another color camera
_COLOR_POINTS = 3000  # approximate number of pixels per image whose colors are compared
_BLUR = 1.5  # [px]
_SAME_SURFACE = 0.03  # relative difference of depth


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
    factor: float = 1.0  # scale of depth
    bend: float = 0.0  # k1 of radial distortion that the images still have
    is_range: bool = False  # if distance from the camera is stored instead of depth along its axis


@dataclass(frozen=True)
class ReadingFit:
    """Agreement between frames under a reading."""

    name: str
    error: float
    """Median of |z' / z - 1|, depth z carried into another frame and z' found there, or distance of
    features from their epipolar lines, in focal lengths; infinite if the frames hardly overlap."""
    inside: float  # fraction of points on measured depth of the other frame, or before both cameras


@dataclass(frozen=True)
class ColorFit:
    """Error of colors with the color camera as read and the one that fits best."""

    cost: float
    best_cost: float
    focal_length: float  # [px], that fits best
    p_DC: tuple[float, float]  # [m], right and down from the depth camera, that fits best
    problem: str

    def __str__(self) -> str:
        x, y = self.p_DC
        return (
            f"{self.cost:12.4f}  as it was read\n{self.best_cost:12.4f}  best: color focal length "
            f"{self.focal_length:.0f} px, color camera at ({x:+.3f}, {y:+.3f}, 0) m in the depth "
            "camera"
        )


@dataclass(frozen=True, eq=False)
class CheckReport:
    """The result of `check_capture`."""

    capture: Capture
    pairs: int = 0
    agreement: ReadingFit | None = None  # None if nothing could be compared
    others: tuple[ReadingFit, ...] = ()  # other readings, the best first
    color: ColorFit | None = None
    problem: str = ""  # the most likely error in one sentence; empty if none was found
    undetermined: str = ""  # what the frames leave open, and the remedy; empty if nothing

    @property
    def agrees(self) -> bool:
        """True if poses, intrinsics and depth were compared, and agree."""
        return self.agreement is not None and not self.problem

    def __str__(self) -> str:
        capture, dropped = self.capture, self.capture.dropped
        lines = [
            capture.source,
            f"{len(capture)} frames, {len(dropped)} left out, {self.pairs} pairs compared",
            *(f"  left out: {message}" for message in dropped[:10]),
            *capture.notes,
        ]
        if not capture.metric:
            lines.append("the scale is unknown; set capture.scale to fly in the scene")
        if self.agreement is None:
            return "\n".join([*lines, "not compared: the images share too few features"])
        if not capture.has_depth:
            lines.append("distance of features from epipolar lines, in focal lengths:")
        lines.append(f"{'median error':>12}  {'overlap':>7}  reading")
        lines += [
            f"{each.error:12.2%}  {each.inside:7.0%}  {each.name}"
            for each in (self.agreement, *self.others[:12])
        ]
        if self.color is not None:
            lines += ["color against depth, 1 - correlation between frames:", str(self.color)]
        lines += [self.undetermined] if self.undetermined else []
        lines.append("does not agree" if self.problem else "agrees")
        return "\n".join(lines)


@dataclass(kw_only=True)
class CheckConfig(Config):
    """Options of a check."""

    pairs: int = bounded(12, "[1, 1000]")  # number of pairs of frames that are compared
    capture: CaptureConfig = field(default_factory=CaptureConfig)


def run(*, capture: str | Path, config: CheckConfig) -> CheckReport:
    """Checks the capture in a folder and prints the report."""
    config.validate()
    report = check_capture(read_capture(capture, config.capture), config.pairs)
    print(report)
    return report


def doubts(capture: Capture) -> tuple[str, ...]:
    """Returns the error that `check_capture` finds, and what it leaves open, as warnings."""
    try:
        report = check_capture(capture)
    except ValueError as error:
        return (f"not checked whether the capture agrees with itself: {error}",)
    found = (report.undetermined,) if report.undetermined else ()
    if report.problem:
        what = f"the capture does not agree with itself, {report.problem}"
        found = f"{what}; see `splatpilot capture check`", *found
    return found


def check_capture(capture: Capture, pairs: int = 12) -> CheckReport:
    """Measures the agreement of a capture with itself, as read and in other readings. It agrees if
    its median relative error is at most 2 %, no other reading leaves less than half of an error
    above 0.2 %, and colors follow depth. Without depth, features are compared instead, see
    `epipolar_errors`, with a tolerance of 1 % of the focal length."""
    if not capture.has_depth:
        return _check_features(capture, pairs)
    found = _choose_pairs(capture, pairs)
    if sum(len(pair.depth) for pair in found) < _MIN_POINTS:
        raise ValueError(f"{capture.source}: too few pixels have depth in two frames to compare")

    def measure(reading: Reading) -> ReadingFit:
        error = np.concatenate([_relative_errors(reading, pair) for pair in found])
        inside = len(error) / sum(len(pair.depth) for pair in found)
        median = float(np.median(error)) if inside >= _MIN_INSIDE else np.inf
        return ReadingFit(reading.name, median, inside)

    as_read = Reading("as it was read", (capture.depth_camera or capture).K, capture.axes.R_BC)
    agreement = measure(as_read)
    readings = _pose_readings(as_read) + _depth_readings(as_read)
    readings += _camera_readings(as_read, capture)
    readings.append(_fit(_zoomed, as_read, measure, [0.1]))
    readings.append(_fit(_shifted, as_read, measure, [0.05, 0.05]))
    others, color = _sorted_fits(measure, readings), None
    X_CW = capture.X_WCs[0].inverse()
    if all((X_CW @ X_WC).IsNearlyIdentity(1e-9) for X_WC in capture.X_WCs):
        problem = (
            f"all {len(capture)} poses are the same; if the camera moved, look at the file that "
            "they were read from"
        )
    else:
        what = "the median error of depth between frames"
        remedy = ", try capture.refine_poses"
        problem = _find_problem(agreement, others[0], _TOLERANCE, what, remedy)
    if not problem:
        color = fit_color_camera(capture, [pair.frames for pair in found])
        problem = color.problem if color is not None else ""
    return CheckReport(capture, len(found), agreement, others, color, problem)


def _sorted_fits(
    measure: Callable[[Reading], ReadingFit], readings: Sequence[Reading]
) -> tuple[ReadingFit, ...]:
    return tuple(sorted(map(measure, readings), key=lambda fit: fit.error))


def _find_problem(
    agreement: ReadingFit, best: ReadingFit, tolerance: float, what: str, remedy: str = ""
) -> str:
    """Returns the most likely error, given the best other reading; empty without any."""
    if agreement.error > _NEGLIGIBLE and best.error < _MIN_GAIN * agreement.error:
        left = f"would be {best.error:.2%} instead of {agreement.error:.2%}"
        return f"most likely {best.name}: {what} {left}"
    if agreement.error <= tolerance:
        return ""
    return (
        f"{what} is {agreement.error:.1%}, more than {tolerance:.0%}, and no other reading "
        f"explains it (the best, {best.name}, leaves {best.error:.1%}); poses may be inaccurate"
        f"{remedy}, or things may have moved"
    )


def _check_features(capture: Capture, pairs: int) -> CheckReport:
    """Measures how well poses and intrinsics explain features that frames share."""
    matched = match_frames(capture, pairs)
    if sum(len(pair.pixels[0]) for pair in matched) < _MIN_POINTS:
        return CheckReport(capture)
    R_BC = capture.axes.R_BC
    X_FW = RigidTransform(capture.axes.R_WF.inverse()) @ RigidTransform(capture.origin)
    X_CB = RigidTransform(R_BC.inverse())
    poses = [X_FW @ X_WC @ X_CB for X_WC in capture.X_WCs]

    def measure(reading: Reading) -> ReadingFit:
        X = RigidTransform(reading.R_BC)
        errors, before = [], []
        for pair in matched:
            a, b = (reading.pose(poses[k]) for k in pair.frames)
            X_BA = (b @ X).inverse() @ a @ X
            error, ahead = epipolar_errors(reading.K, reading.bend, pair, X_BA)
            errors.append(error)
            before.append(ahead)
        inside = float(np.concatenate(before).mean())
        median = float(np.median(np.concatenate(errors)))
        return ReadingFit(reading.name, median if inside >= _MIN_BEFORE else np.inf, inside)

    as_read = Reading("as it was read", capture.K, R_BC)
    readings = _pose_readings(as_read) + _camera_readings(as_read, capture)
    # A wrong principal point, which looks like a camera that is mounted askew, is not fitted.
    readings.append(_fit(_zoomed, as_read, measure, [0.1]))
    readings.append(_fit(_bent, as_read, measure, [0.1], (1e-3, 1e-7, 60)))
    agreement, others = measure(as_read), _sorted_fits(measure, readings)
    what = "the median distance of features from their epipolar lines, in focal lengths,"
    problem = _find_problem(agreement, others[0], _EPIPOLAR_TOLERANCE, what)
    # Along the optical axis any focal length fits, if distances along it grow alike.
    undetermined, focal = "", as_read.K[0, 0]
    zoomed = [(z * focal, as_read.K @ np.diag([z, z, 1.0])) for z in _ZOOMS]
    error, other = min((measure(replace(as_read, K=K)).error, f) for f, K in zoomed)
    fits = error < max(2.0 * agreement.error, _NEGLIGIBLE)
    folder, config = capture.folder, capture.config
    given = complete_config(Path(folder), config) if folder else config
    if fits and not problem and not given.intrinsics:
        angle = 2.0 * np.degrees(np.arctan2(capture.width / 2, focal))
        undetermined = (
            f"these frames do not tell the focal length: {other:.0f} px fits about as well as "
            f"{focal:.0f} px, a field of view of {angle:.0f} degrees; film turns and motion to the "
            "side, too, or set capture.intrinsics"
        )
    return CheckReport(capture, len(matched), agreement, others, None, problem, undetermined)


def _choose_pairs(capture: Capture, count: int) -> list[FramePair]:
    """Chooses frames spread over the capture, each with one of the next 16: the first whose camera
    has moved by an eighth of the median depth or rotated by 10 to 45 degrees, else the last."""
    camera = capture.depth_camera
    X_CD = camera.X_CD if camera is not None else RigidTransform()
    X_DB = X_CD @ RigidTransform(capture.axes.R_BC.inverse())
    X_FW = RigidTransform(capture.axes.R_WF.inverse()) @ RigidTransform(capture.origin)
    pairs = []
    for i in np.unique(np.linspace(0, len(capture) - 2, count).astype(int)).tolist():
        depth = capture.measured_depth(i)
        if depth is None:
            continue
        step = _grid_step(depth, _DEPTH_POINTS)
        p_CQ, rows, columns = depth_points(capture.K, depth, step, start=step // 2)
        j = _later_frame(capture, i, float(np.median(p_CQ[:, 2]))) if len(p_CQ) else None
        other = capture.measured_depth(j) if j is not None else None
        if j is None or other is None:
            continue
        X_FBs = tuple(X_FW @ capture.X_WCs[k] @ X_DB for k in (i, j))
        pixels = np.array([columns + 0.5, rows + 0.5], dtype=np.float64)
        pairs.append(FramePair(pixels, p_CQ[:, 2], X_FBs, other, (i, j)))
    return pairs


def _grid_step(image: NDArray, count: int) -> int:
    """Returns the step along both axes that leaves about `count` pixels."""
    return max(1, round((image.size / count) ** 0.5))


def _later_frame(capture: Capture, i: int, depth: float) -> int | None:
    j = None
    for j in range(i + 1, min(i + 17, len(capture))):
        X = capture.X_WCs[i].inverse() @ capture.X_WCs[j]
        angle = X.rotation().ToAngleAxis().angle()
        moved = np.linalg.norm(X.translation()) > depth / 8 or abs(angle) > np.deg2rad(10)
        if moved and abs(angle) < np.deg2rad(45):
            break
    return j


def _relative_errors(reading: Reading, pair: FramePair) -> NDArray[np.float64]:
    def depth(stored: NDArray, u: NDArray, v: NDArray) -> NDArray[np.float64]:
        z = reading.factor * stored.astype(np.float64)
        if not reading.is_range:
            return z
        return z / np.linalg.norm(back_project(reading.K, u, v, np.ones(u.shape)), axis=-1)

    (u, v), R_BC = pair.pixels, RigidTransform(reading.R_BC)
    a, b = (reading.pose(X_FB) @ R_BC for X_FB in pair.X_FBs)
    p_CQ = back_project(reading.K, u, v, depth(pair.depth, u, v))
    p_CQ = (b.inverse() @ a).multiply(p_CQ.T).T
    height, width = pair.other.shape
    hit, rows, columns = project_points(reading.K, p_CQ, width, height)
    found = depth(pair.other[rows, columns], columns + 0.5, rows + 0.5)
    known = (found > 0) & np.isfinite(found)
    return np.minimum(np.abs(found[known] / p_CQ[hit, 2][known] - 1), 1.0)


def _pose_readings(as_read: Reading) -> list[Reading]:
    """Returns the readings with one known error of poses each undone, which is their name."""

    def posed(name: str, rotation: Callable, translation: Callable) -> Reading:
        def pose(X_FB: RigidTransform) -> RigidTransform:
            R = RotationMatrix(rotation(X_FB.rotation().matrix()))
            return RigidTransform(R, translation(X_FB.translation()))

        return replace(as_read, name=name, pose=pose)

    def w_last(R: NDArray[np.float64]) -> NDArray[np.float64]:
        return Rotation.from_quat(Rotation.from_matrix(R).as_quat()[[1, 2, 3, 0]]).as_matrix()

    equal = (name for name, R in _BODIES.items() if np.allclose(R, as_read.R_BC.matrix()))
    present, columns = next(equal, "its axes"), "rotations are stored column by column"
    readings = [
        posed("quaternions are w x y z, read as x y z w", w_last, lambda p: p),
        posed(f"{columns}, read row by row", lambda R: R.T, lambda p: p),
    ]
    for name, R in _BODIES.items():
        body = replace(as_read, R_BC=RotationMatrix(np.array(R, dtype=float)))
        also = "" if name == present else f", and of {name}"
        if also:
            readings.append(replace(body, name=f"poses are those of {name}, read as {present}"))
        name = f"poses are world to camera{also}, read as camera to world"
        readings.append(replace(body, name=name, pose=lambda X_FB: X_FB.inverse()))
    for axis, signs in zip("xyz", 1 - 2 * np.eye(3), strict=True):
        M, name = np.diag(signs), f"the world is left-handed: {axis} is mirrored"
        readings.append(posed(name, lambda R, M=M: M @ R @ M, lambda p, M=M: M @ p))
    for name, M in _WORLDS.items():
        name = f"positions and rotations are in different worlds: {name} differ"
        readings.append(posed(name, lambda R: R, lambda p, M=M: M @ p))
    return readings


def _depth_readings(as_read: Reading) -> list[Reading]:
    is_range = "depth is the distance from the camera, read as depth along its axis"
    readings = [replace(as_read, name=is_range, is_range=True)]
    for factor in _DEPTH_FACTORS:
        large = f"depth is {1 / factor:g} times too large, or positions too small"
        small = f"depth is {factor:g} times too small, or positions too large"
        readings.append(replace(as_read, name=large if factor < 1 else small, factor=factor))
    return readings


def _camera_readings(as_read: Reading, capture: Capture) -> list[Reading]:
    readings = []
    for factor in _IMAGE_FACTORS:
        name = f"intrinsics belong to images {1 / factor:g} times as large"
        readings.append(replace(as_read, name=name, K=np.diag([factor, factor, 1]) @ as_read.K))
    camera, K = capture.depth_camera or capture, as_read.K.copy()
    K[:2, 2] = camera.width / 2, camera.height / 2
    if not np.allclose(K, as_read.K, atol=1):
        readings.append(replace(as_read, name="the principal point is the image's center", K=K))
    return readings


def _zoomed(as_read: Reading, x: NDArray) -> Reading:
    K = as_read.K.copy()
    K[:2, :2] *= np.exp(x[0])
    return replace(as_read, name=f"the focal length is wrong: {K[0, 0]:.1f} px fits best", K=K)


def _shifted(as_read: Reading, x: NDArray) -> Reading:
    K = as_read.K.copy()
    K[:2, 2] += K[0, 0] * x
    name = f"the principal point is wrong: ({K[0, 2]:.1f}, {K[1, 2]:.1f}) px fits best"
    return replace(as_read, name=name, K=K)


def _bent(as_read: Reading, x: NDArray) -> Reading:
    k1 = float(x[0])
    name = f"the images are still distorted: k1 = {k1:.2f} fits best"
    return replace(as_read, name=name, bend=k1)


def _fit(
    change: Callable[[Reading, NDArray], Reading],
    as_read: Reading,
    measure: Callable[[Reading], ReadingFit],
    steps: Sequence[float],
    options: tuple[float, float, int] = (1e-4, 1e-6, 80),
) -> Reading:
    """Returns the change of a reading that fits best."""
    x, _ = _minimize(lambda x: min(measure(change(as_read, x)).error, 1.0), steps, *options)
    return change(as_read, x)


def _minimize(
    cost: Callable[[NDArray], float], steps: Sequence[float], xatol: float, fatol: float, most: int
) -> tuple[NDArray[np.float64], float]:
    """Returns the minimum from zero by Nelder and Mead, and its cost, after `most` trials."""
    count = len(steps)
    simplex = np.concatenate([np.zeros((1, count)), np.diag(steps)])
    options = {"initial_simplex": simplex, "xatol": xatol, "fatol": fatol, "maxfev": most}
    fit = minimize(cost, np.zeros(count), method="Nelder-Mead", options=options)
    return fit.x, float(fit.fun)


def fit_color_camera(capture: Capture, pairs: Sequence[tuple[int, int]]) -> ColorFit | None:
    """Fits the focal length and position of the color camera, its axes parallel to depth's, by the
    correlation between frames of the luminance of surface points, which does not depend on
    exposure. Returns None if too few points are seen twice."""
    depth_camera = capture.depth_camera
    K_D = capture.K if depth_camera is None else depth_camera.K
    X_DC = RigidTransform() if depth_camera is None else depth_camera.X_CD.inverse()
    seen = [(i, j, _common_points(capture, K_D, X_DC, i, j)) for i, j in pairs]
    colored = [
        tuple((p_DQ, _luminance(capture, k)) for p_DQ, k in zip(points, (i, j), strict=True))
        for i, j, points in seen
        if points is not None
    ]
    if not colored:
        return None

    def cost(x: NDArray[np.float64]) -> float:
        K = capture.K.copy()
        K[:2, :2] *= np.exp(x[0])
        X = RigidTransform(X_DC.rotation(), X_DC.translation() + np.array([x[1], x[2], 0]))
        found = [1 - each for pair in colored if (each := _correlation(pair, K, X)) is not None]
        return float(np.mean(found)) if len(found) > len(colored) / 2 else 2.0

    as_read = cost(np.zeros(3))
    fit, left = _minimize(cost, (-0.1, 0.03, 0.03), 1e-3, 1e-5, 90)
    focal_length = float(capture.K[0, 0] * np.exp(fit[0]))
    x, y = (X_DC.translation()[:2] + fit[1:]).tolist()
    problem = ""
    moved = np.linalg.norm(fit[1:]) > _MIN_SHIFT or abs(fit[0]) > _MIN_LOG_ZOOM
    if as_read > _COLOR_NEGLIGIBLE and left < _MIN_COLOR_GAIN * as_read and moved:
        problem = (
            "most likely color and depth are not registered: a color camera of focal length "
            f"{focal_length:.0f} px at ({x:+.3f}, {y:+.3f}, 0) m in the depth camera leaves "
            f"{left:.3f} of disagreement between colors instead of {as_read:.3f}"
        )
    elif as_read > _COLOR_TOLERANCE:
        problem = (
            f"colors do not follow depth: 1 - their correlation between frames is {as_read:.2f}, "
            f"at most {_COLOR_TOLERANCE} is plausible; intrinsics may be those of another camera"
        )
    return ColorFit(as_read, left, focal_length, (x, y), problem)


def _common_points(
    capture: Capture, K_D: NDArray[np.float64], X_DC: RigidTransform, i: int, j: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Returns the points (3, n) [m] of frame i that frame j sees too, in both depth cameras."""
    a, b = capture.measured_depth(i), capture.measured_depth(j)
    if a is None or b is None:
        return None
    p_DQ = depth_points(K_D, a, _grid_step(a, _COLOR_POINTS))[0].T
    X_WDs = [capture.X_WCs[k] @ X_DC.inverse() for k in (i, j)]
    q = (X_WDs[1].inverse() @ X_WDs[0]).multiply(p_DQ)
    seen, rows, columns = project_points(K_D, q.T, b.shape[1], b.shape[0])
    seen[seen] = np.abs(b[rows, columns] - q[2][seen]) < _SAME_SURFACE * q[2][seen]
    return (p_DQ[:, seen], q[:, seen]) if seen.sum() >= _MIN_COLOR_POINTS else None


def _luminance(capture: Capture, i: int) -> NDArray[np.float32]:
    """Returns the blurred luminance (H, W), NaN in invalid pixels."""
    gray = cv2.cvtColor(capture.load_image(i), cv2.COLOR_RGB2GRAY).astype(np.float32)
    valid = np.broadcast_to(capture.load_valid(i), gray.shape)
    sums, weights = (
        cv2.GaussianBlur(each.astype(np.float32), (0, 0), _BLUR) for each in (gray * valid, valid)
    )
    return np.divide(sums, weights, out=np.full_like(gray, np.nan), where=valid)


def _correlation(
    pair: Sequence[tuple[NDArray[np.float64], NDArray[np.float32]]],
    K: NDArray[np.float64],
    X_DC: RigidTransform,
) -> float | None:
    """Returns the correlation of luminance at points p_DQ that two images show, if enough."""
    samples = []
    for p_DQ, image in pair:
        x, y, z = X_DC.inverse().multiply(p_DQ)
        u, v = ((each - 0.5).astype(np.float32) for each in project(K, x, y, z))
        sampled = cv2.remap(image, u[None], v[None], cv2.INTER_LINEAR, borderValue=-1.0)[0]
        height, width = image.shape
        inside = (z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        samples.append(np.where(inside, sampled, np.nan))
    both = np.isfinite(samples).all(axis=0)
    a, b = (each[both] for each in samples)
    if both.sum() < _MIN_COLOR_POINTS or a.std() == 0 or b.std() == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])
