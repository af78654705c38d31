"""Checks whether poses, intrinsics and depth of a capture agree, and finds a likely mistake if not.

The capture as read, and readings of its files that each undo one known mistake, are measured on the
same pairs of frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from splatpilot.systems.common.validation import Config, bounded
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.frame_comparison import (
    ColorFit,
    FramePair,
    Reading,
    ReadingFit,
    choose_pairs,
    fit_color_camera,
    initial_reading,
    measure_reading,
)

_BODIES = {
    "optical axes (x right, y down, z forward)": np.eye(3),
    "OpenGL axes (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
    "a north-east-down body (x forward, y right, z down)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "an east-north-up body (x forward, y left, z up)": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}
_WORLDS = {
    "east and north": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    "y and z": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "up and down": np.diag([1, -1, -1]),
}
_DEPTH_FACTORS = (0.001, 0.01, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 100.0, 1000.0)
_IMAGE_FACTORS = (0.25, 0.5, 0.75, 4 / 3, 2.0, 4.0)
_MIN_POINTS = 200
"""Of all pairs together, for a conclusion."""
_TOLERANCE = 0.02
"""Median relative error up to which a capture agrees with itself."""
_NEGLIGIBLE = 0.002
"""Median relative error up to which other readings are ignored."""
_MIN_GAIN = 0.5
"""Maximum fraction of the error that another reading may leave to be accepted."""


def _readings_without_mistakes(as_read: Reading, capture: Capture) -> list[Reading]:
    """Returns the readings with one known mistake each undone, which is their name."""
    readings = []

    def add(name: str, **changes: object) -> None:
        readings.append(replace(as_read, name=name, **changes))  # pyright: ignore[reportArgumentType]

    present = next(
        (name for name, R in _BODIES.items() if np.allclose(R, as_read.R_BC.matrix())), "its axes"
    )
    add("depth is the distance from the camera, read as depth along its axis", is_range=True)
    add("quaternions are w x y z, read as x y z w", pose=_from_wxyz)
    add(
        "rotations are stored column by column, read row by row",
        pose=lambda X_FB: RigidTransform(X_FB.rotation().inverse(), X_FB.translation()),
    )
    for name, R in _BODIES.items():
        R_BC = RotationMatrix(np.array(R, dtype=float))
        also = "" if name == present else f", and of {name}"
        if also:
            add(f"poses are those of {name}, read as {present}", R_BC=R_BC)
        add(
            f"poses are world to camera{also}, read as camera to world",
            R_BC=R_BC,
            pose=lambda X_FB: X_FB.inverse(),
        )
    for axis, S in zip("xyz", 1 - 2 * np.eye(3), strict=True):
        add(f"the world is left-handed: {axis} is mirrored", pose=_mirror(np.diag(S)))
    for name, M in _WORLDS.items():
        add(
            f"positions and rotations are in different worlds: {name} differ",
            pose=_move(np.array(M, dtype=float)),
        )
    for factor in _DEPTH_FACTORS:
        large = f"depth is {1 / factor:g} times too large, or positions too small"
        small = f"depth is {factor:g} times too small, or positions too large"
        add(large if factor < 1 else small, factor=factor)
    for factor in _IMAGE_FACTORS:
        K = np.diag([factor, factor, 1]) @ as_read.K
        add(f"intrinsics belong to images {1 / factor:g} times as large", K=K)
    camera = capture.depth_camera or capture
    K = as_read.K.copy()
    K[:2, 2] = camera.width / 2, camera.height / 2
    if not np.allclose(K, as_read.K, atol=1):
        add("the principal point is the image's center", K=K)
    return readings


def _from_wxyz(X_FB: RigidTransform) -> RigidTransform:
    """Undoes that w x y z was read as x y z w."""
    w, x, y, z = X_FB.rotation().ToQuaternion().wxyz()
    return RigidTransform(Quaternion(np.array([x, y, z, w])), X_FB.translation())


def _mirror(M: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    return lambda X_FB: RigidTransform(
        RotationMatrix(M @ X_FB.rotation().matrix() @ M), M @ X_FB.translation()
    )


def _move(M: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    return lambda X_FB: RigidTransform(X_FB.rotation(), M @ X_FB.translation())


def _fitted_readings(as_read: Reading, pairs: Sequence[FramePair]) -> list[Reading]:
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
            lambda x, make=make: min(measure_reading(make(x), pairs).error, 1.0),
            np.zeros(size),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6, "maxfev": 80},
        )
        readings.append(make(result.x))
    return readings


@dataclass(frozen=True)
class CheckReport:
    """The result of `check_capture`."""

    capture: str
    frames: int
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    metric: bool
    pairs: int = 0
    agreement: ReadingFit | None = None
    """None if there is no depth to compare."""
    others: tuple[ReadingFit, ...] = ()
    """Other readings, the best first."""
    color: ColorFit | None = None
    mistake: str = ""
    """The most likely mistake in one sentence; empty if none was found."""

    @property
    def agrees(self) -> bool:
        """Whether poses, intrinsics and depth were compared, and agree."""
        return self.agreement is not None and not self.mistake

    def __str__(self) -> str:
        lines = [
            f"{self.capture}",
            f"{self.frames} frames, {len(self.dropped)} left out, {self.pairs} pairs compared",
            *(f"  left out: {message}" for message in self.dropped[:10]),
            *self.notes,
        ]
        if not self.metric:
            lines.append("the scale is unknown; set capture.scale to fly in the scene")
        if self.agreement is None:
            return "\n".join([*lines, "not compared: there is no depth"])
        lines.append(f"{'median error':>12}  {'overlap':>7}  reading")
        lines += [
            f"{each.error:12.2%}  {each.inside:7.0%}  {each.name}"
            for each in (self.agreement, *self.others[:12])
        ]
        if self.color is not None:
            lines += ["color against depth, 1 - correlation between frames:", str(self.color)]
        lines.append("does not agree" if self.mistake else "agrees")
        return "\n".join(lines)


@dataclass(kw_only=True)
class CheckConfig(Config):
    """How a capture is checked."""

    pairs: int = bounded(12, "[1, 1000]")
    """Number of pairs of frames that are compared."""
    capture: CaptureConfig = field(default_factory=CaptureConfig)


def run(*, capture: str | Path, config: CheckConfig) -> CheckReport:
    """Checks the capture in a folder and prints the report.

    Raises:
        ValueError, OSError: if the capture is missing, damaged or cannot be compared.
    """
    config.validate()
    report = check_capture(read_capture(capture, config.capture), config.pairs)
    print(report)
    return report


def doubts(capture: Capture) -> tuple[str, ...]:
    """Returns the mistake that `check_capture` finds, if any, as a warning."""
    if not capture.has_depth:
        return ()
    try:
        mistake = check_capture(capture).mistake
    except ValueError as error:
        return (f"not checked whether the capture agrees with itself: {error}",)
    if not mistake:
        return ()
    return (f"the capture does not agree with itself, {mistake}; see `splatpilot capture check`",)


def check_capture(capture: Capture, pairs: int = 12) -> CheckReport:
    """Measures how well a capture agrees with itself, as read and in other readings.

    It agrees if its median relative error is at most 2 %, no other reading leaves less than half of
    an error above 0.2 %, and colors follow depth. Without depth only its properties are reported.

    Args:
        pairs: number of pairs of frames that are compared.

    Raises:
        ValueError: if it has depth, but too little of it.
    """
    report = CheckReport(
        capture=capture.source,
        frames=len(capture),
        dropped=tuple(capture.dropped),
        notes=tuple(capture.notes),
        metric=capture.metric,
    )
    if not capture.has_depth:
        return report
    found = choose_pairs(capture, pairs)
    if sum(len(pair.depth) for pair in found) < _MIN_POINTS:
        raise ValueError(f"{capture.source}: too few pixels have depth in two frames to compare")
    as_read = initial_reading(capture)
    agreement = measure_reading(as_read, found)
    readings = _readings_without_mistakes(as_read, capture) + _fitted_readings(as_read, found)
    others = sorted((measure_reading(each, found) for each in readings), key=lambda fit: fit.error)
    best, color = others[0], None
    X_CW = capture.X_WCs[0].inverse()
    if all((X_CW @ X_WC).IsNearlyIdentity(1e-9) for X_WC in capture.X_WCs):
        mistake = (
            f"all {len(capture)} poses are the same; if the camera moved, look at the file that "
            "they were read from"
        )
    elif agreement.error > _NEGLIGIBLE and best.error < _MIN_GAIN * agreement.error:
        mistake = (
            f"most likely {best.name}: the median error would be {best.error:.2%} instead of "
            f"{agreement.error:.2%}"
        )
    elif agreement.error > _TOLERANCE:
        mistake = (
            f"the median error of depth between frames is {agreement.error:.1%}, more than "
            f"{_TOLERANCE:.0%}, and no known mistake explains it (the best, {best.name}, "
            f"leaves {best.error:.1%}); poses may be inaccurate, try capture.refine_poses, or "
            "things may have moved"
        )
    else:
        color = fit_color_camera(capture, [pair.frames for pair in found])
        mistake = color.mistake if color is not None else ""
    return replace(
        report,
        pairs=len(found),
        agreement=agreement,
        others=tuple(others),
        color=color,
        mistake=mistake,
    )
