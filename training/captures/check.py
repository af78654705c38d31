"""Whether poses, intrinsics and depth of a capture agree, and if not, which mistake explains it.

Depth of one frame is carried into another frame and compared with the depth that stands there: with
the right reading of the files both are the same surface. The measure is the median of |z' / z - 1|
over points of many pairs of frames, z carried over and z' found. Readings with one known mistake
each are measured on the same pairs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from flysplat.training.captures.capture import Capture
from flysplat.training.captures.capture_config import CaptureConfig
from flysplat.training.captures.read_capture import read_capture
from flysplat.training.captures.registration import ColorFit, fit_color_camera, grid_step

_POINTS = 5000
"""About how many pixels of an image are carried over."""
_FEWEST = 200
_LEAST_INSIDE = 0.1
"""Of the points, the fraction that must fall onto measured depth for a reading to count."""

TOLERANCE = 0.02
"""Median relative error up to which a capture agrees with itself."""
_NEGLIGIBLE = 0.002
"""Median relative error below which no other reading is looked for."""
_BETTER = 0.5
"""What fraction of the error another reading must leave to be believed."""

_BODIES = {
    "optical axes (x right, y down, z forward)": np.eye(3),
    "OpenGL axes (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
    "a north-east-down body (x forward, y right, z down)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "an east-north-up body (x forward, y left, z up)": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}


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
class Agreement:
    """How well a reading fits."""

    name: str
    error: float
    """Median relative error of depth; infinite if the frames hardly overlap."""
    inside: float
    """The fraction of points that fall onto measured depth in the other frame."""


@dataclass(frozen=True)
class CheckReport:
    """What `check_capture` found."""

    capture: str
    frames: int
    dropped: tuple[str, ...]
    pairs: int
    agreement: Agreement
    others: tuple[Agreement, ...]
    """Other readings, the best first."""
    color: ColorFit | None
    mistake: str
    """The most likely mistake in one sentence; empty if the capture agrees."""

    @property
    def agrees(self) -> bool:
        """Whether poses, intrinsics and depth agree."""
        return not self.mistake

    def __str__(self) -> str:
        lines = [
            f"{self.capture}",
            f"{self.frames} frames, {len(self.dropped)} left out, {self.pairs} pairs compared",
            *(f"  left out: {message}" for message in self.dropped[:10]),
            f"{'median error':>12}  {'overlap':>7}  reading",
            *(
                f"{each.error:12.2%}  {each.inside:7.0%}  {each.name}"
                for each in (self.agreement, *self.others[:12])
            ),
        ]
        if self.color is not None:
            lines += ["colour against depth, 1 - correlation between frames:", str(self.color)]
        lines.append("does not agree" if self.mistake else "agrees")
        return "\n".join(lines)


@dataclass(kw_only=True)
class CheckConfig:
    """How a capture is checked."""

    pairs: int = 12
    """How many pairs of frames are compared."""
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    """What the capture's files leave open."""

    def validate(self) -> None:
        """Raises ValueError for values that make no sense."""
        if not 1 <= self.pairs <= 1000:
            raise ValueError(f"pairs is {self.pairs}; 1 to 1000 are needed")


def run(*, capture: str | Path, config: CheckConfig) -> CheckReport:
    """Checks the capture in a folder and prints the report.

    Raises:
        FileNotFoundError, OSError: if files are missing.
        ValueError: if the capture is damaged, cannot be compared, or does not agree; the message
            is then the most likely mistake.
    """
    config.validate()
    report = check_capture(read_capture(capture, config.capture), config.pairs)
    print(report)
    if not report.agrees:
        raise ValueError(f"{capture}: {report.mistake}")
    return report


def check_capture(capture: Capture, pairs: int = 12) -> CheckReport:
    """Measures how well a capture agrees with itself, as it is read and in other readings.

    A capture agrees if its median relative error is at most 2 %, no other reading leaves less than
    half of an error above 0.2 %, and colours follow depth about as well as they can.

    Args:
        pairs: how many pairs of frames are compared.

    Raises:
        ValueError: if it has no depth, or too little of it to tell.
    """
    if not capture.has_depth:
        raise ValueError(f"{capture.source}: no depth, so there is nothing to compare")
    found = choose_pairs(capture, pairs)
    if sum(len(pair.depth) for pair in found) < _FEWEST:
        raise ValueError(f"{capture.source}: too few pixels have depth in two frames to compare")
    as_read = reading_of(capture)
    agreement = agreement_of(as_read, found)
    others = [agreement_of(other, found) for other in other_readings(as_read, capture)]
    others += [agreement_of(other, found) for other in _fitted(as_read, found)]
    others.sort(key=lambda each: each.error)
    best = others[0]
    color = None
    mistake = ""
    if agreement.error > _NEGLIGIBLE and best.error < _BETTER * agreement.error:
        mistake = (
            f"most likely {best.name}: the median error would be {best.error:.2%} instead of "
            f"{agreement.error:.2%}"
        )
    elif agreement.error > TOLERANCE:
        mistake = (
            f"the median error of depth between frames is {agreement.error:.1%}, at most "
            f"{TOLERANCE:.0%} is needed, and no known mistake explains it (the best, {best.name}, "
            f"leaves {best.error:.1%}); poses may be inaccurate or things may have moved"
        )
    else:
        color = fit_color_camera(capture, [pair.frames for pair in found])
        mistake = color.mistake if color is not None else ""
    return CheckReport(
        capture=capture.source,
        frames=len(capture),
        dropped=tuple(capture.dropped),
        pairs=len(found),
        agreement=agreement,
        others=tuple(others),
        color=color,
        mistake=mistake,
    )


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

    def X_FB(i: int) -> RigidTransform:
        return R_WF.inverse() @ capture.X_WCs[i] @ X_CD @ R_BC.inverse()

    pairs = []
    for i in np.unique(np.linspace(0, len(capture) - 2, count).astype(int)).tolist():
        depth = capture.load_depth(i)
        if depth is None:
            continue
        step = grid_step(depth, _POINTS)
        rows, columns = np.mgrid[
            step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step
        ]
        z = depth[rows, columns].astype(np.float64)
        known = (z > 0) & np.isfinite(z)
        if not known.any():
            continue
        j = _partner(capture, i, float(np.median(z[known])))
        other = capture.load_depth(j) if j is not None else None
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


def agreement_of(reading: Reading, pairs: Sequence[FramePair]) -> Agreement:
    """Measures a reading on pairs of frames."""
    errors, total = [], 0
    for pair in pairs:
        error = _relative_errors(reading, pair)
        errors.append(error)
        total += len(pair.depth)
    error = np.concatenate(errors)
    inside = len(error) / total
    if inside < _LEAST_INSIDE:
        return Agreement(reading.name, np.inf, inside)
    return Agreement(reading.name, float(np.median(error)), inside)


def _relative_errors(reading: Reading, pair: FramePair) -> NDArray[np.float64]:
    f, c = np.diag(reading.K)[:2, None], reading.K[:2, 2, None]
    rays = np.concatenate([(pair.pixels - c) / f, np.ones((1, pair.pixels.shape[1]))])
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


def other_readings(as_read: Reading, capture: Capture) -> list[Reading]:
    """Returns the readings with one known mistake each undone; their names say the mistake."""
    present = next(
        (name for name, R in _BODIES.items() if np.allclose(R, as_read.R_BC.matrix())), "its axes"
    )
    readings = [
        replace(
            as_read,
            name="depth is the distance from the camera, read as depth along its axis",
            is_range=True,
        ),
        replace(as_read, name="quaternions are w x y z, read as x y z w", pose=_from_wxyz),
    ]
    for name, R in _BODIES.items():
        R_BC = RotationMatrix(np.array(R, dtype=float))
        if name != present:
            readings.append(
                replace(as_read, name=f"poses are those of {name}, read as {present}", R_BC=R_BC)
            )
        also = "" if name == present else f", and of {name}"
        readings.append(
            replace(
                as_read,
                name=f"poses are world to camera{also}, read as camera to world",
                R_BC=R_BC,
                pose=lambda X_FB: X_FB.inverse(),
            )
        )
    for axis, S in zip("xyz", 1 - 2 * np.eye(3), strict=True):
        readings.append(
            replace(
                as_read, name=f"the world is left-handed: {axis} is mirrored", pose=_mirrored(S)
            )
        )
    for name, M in (
        ("east and north", [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
        ("y and z", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        ("up and down", np.diag([1, -1, -1])),
    ):
        readings.append(
            replace(
                as_read,
                name=f"positions and rotations are in different worlds: {name} differ",
                pose=_moved(np.array(M, dtype=float)),
            )
        )
    for factor in (0.001, 0.01, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 100.0, 1000.0):
        readings.append(
            replace(
                as_read,
                name=f"depth is {1 / factor:g} times too large, or positions too small"
                if factor < 1
                else f"depth is {factor:g} times too small, or positions too large",
                factor=factor,
            )
        )
    for factor in (0.25, 0.5, 0.75, 4 / 3, 2.0, 4.0):
        K = np.diag([factor, factor, 1]) @ as_read.K
        readings.append(
            replace(as_read, name=f"intrinsics belong to images {1 / factor:g} times as large", K=K)
        )
    camera = capture.depth_camera or capture
    K = as_read.K.copy()
    K[:2, 2] = camera.width / 2, camera.height / 2
    if not np.allclose(K, as_read.K, atol=1):
        readings.append(replace(as_read, name="the principal point is the image's centre", K=K))
    return readings


def _fitted(as_read: Reading, pairs: Sequence[FramePair]) -> list[Reading]:
    """Returns readings whose focal length, or principal point, fits best."""

    def focal(x: NDArray) -> Reading:
        K = as_read.K.copy()
        K[:2, :2] *= np.exp(x[0])
        return replace(as_read, name=f"the focal length is wrong: {K[0, 0]:.1f} px fits best", K=K)

    def principal(x: NDArray) -> Reading:
        K = as_read.K.copy()
        K[:2, 2] += K[0, 0] * x
        name = f"the principal point is wrong: ({K[0, 2]:.1f}, {K[1, 2]:.1f}) px fits best"
        return replace(as_read, name=name, K=K)

    readings = []
    for make, size, step in ((focal, 1, 0.1), (principal, 2, 0.05)):
        simplex = np.concatenate([np.zeros((1, size)), step * np.eye(size)])
        result = minimize(
            lambda x, make=make: min(agreement_of(make(x), pairs).error, 1.0),
            np.zeros(size),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6, "maxfev": 80},
        )
        readings.append(make(result.x))
    return readings


def _from_wxyz(X_FB: RigidTransform) -> RigidTransform:
    """Undoes that w x y z was read as x y z w."""
    w, x, y, z = X_FB.rotation().ToQuaternion().wxyz()
    return RigidTransform(Quaternion(np.array([x, y, z, w])), X_FB.translation())


def _mirrored(S: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    M = np.diag(S)
    return lambda X_FB: RigidTransform(
        RotationMatrix(M @ X_FB.rotation().matrix() @ M), M @ X_FB.translation()
    )


def _moved(M: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    return lambda X_FB: RigidTransform(X_FB.rotation(), M @ X_FB.translation())
