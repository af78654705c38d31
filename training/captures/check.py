"""Whether poses, intrinsics and depth of a capture agree, and if not, which mistake explains it.

The capture as it was read and readings with one known mistake each are measured on the same pairs
of frames, see `frame_agreement`. Of a capture without depth only what was read is reported.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

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
    measure_reading,
    reading_of,
)

_BODIES = {
    "optical axes (x right, y down, z forward)": np.eye(3),
    "OpenGL axes (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
    "a north-east-down body (x forward, y right, z down)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "an east-north-up body (x forward, y left, z up)": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}


def undo_mistakes(as_read: Reading, capture: Capture) -> list[Reading]:
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
        replace(
            as_read,
            name="rotations are stored column by column, read row by row",
            pose=lambda X_FB: RigidTransform(X_FB.rotation().inverse(), X_FB.translation()),
        ),
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
            replace(as_read, name=f"the world is left-handed: {axis} is mirrored", pose=_mirror(S))
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
                pose=_move(np.array(M, dtype=float)),
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


def fit_readings(as_read: Reading, pairs: Sequence[FramePair]) -> list[Reading]:
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


def _from_wxyz(X_FB: RigidTransform) -> RigidTransform:
    """Undoes that w x y z was read as x y z w."""
    w, x, y, z = X_FB.rotation().ToQuaternion().wxyz()
    return RigidTransform(Quaternion(np.array([x, y, z, w])), X_FB.translation())


def _mirror(S: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    M = np.diag(S)
    return lambda X_FB: RigidTransform(
        RotationMatrix(M @ X_FB.rotation().matrix() @ M), M @ X_FB.translation()
    )


def _move(M: NDArray[np.float64]) -> Callable[[RigidTransform], RigidTransform]:
    return lambda X_FB: RigidTransform(X_FB.rotation(), M @ X_FB.translation())


_FEWEST = 200
"""Points, of all pairs together, below which nothing can be told."""
TOLERANCE = 0.02
"""Median relative error up to which a capture agrees with itself."""
_NEGLIGIBLE = 0.002
"""Median relative error below which no other reading is looked for."""
_BETTER = 0.5
"""What fraction of the error another reading must leave to be believed."""


@dataclass(frozen=True)
class CheckReport:
    """What `check_capture` found."""

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
            lines.append("the scale is unknown; capture.scale gives it, if flights are to be flown")
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
        ValueError: if the capture is damaged or cannot be compared.
    """
    config.validate()
    report = check_capture(read_capture(capture, config.capture), config.pairs)
    print(report)
    return report


def doubts(capture: Capture) -> tuple[str, ...]:
    """Returns, as a warning or none, what `check_capture` holds against a capture with depth."""
    if not capture.has_depth:
        return ()
    try:
        mistake = check_capture(capture).mistake
    except ValueError as error:
        return (f"not checked whether the capture agrees with itself: {error}",)
    if not mistake:
        return ()
    return (
        f"the capture does not agree with itself, {mistake}; `splatpilot capture check` tells more",
    )


def check_capture(capture: Capture, pairs: int = 12) -> CheckReport:
    """Measures how well a capture agrees with itself, as it is read and in other readings.

    A capture agrees if its median relative error is at most 2 %, no other reading leaves less than
    half of an error above 0.2 %, and colors follow depth about as well as they can.

    Args:
        pairs: how many pairs of frames are compared.

    Raises:
        ValueError: if it has depth, but too little of it to tell.
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
    if sum(len(pair.depth) for pair in found) < _FEWEST:
        raise ValueError(f"{capture.source}: too few pixels have depth in two frames to compare")
    as_read = reading_of(capture)
    agreement = measure_reading(as_read, found)
    others = [measure_reading(other, found) for other in undo_mistakes(as_read, capture)]
    others += [measure_reading(other, found) for other in fit_readings(as_read, found)]
    others.sort(key=lambda each: each.error)
    best = others[0]
    color = None
    mistake = ""
    if _stands_still(capture):
        mistake = (
            f"all {len(capture)} poses are the same; if the camera moved, look at the file that "
            "they were read from"
        )
    elif agreement.error > _NEGLIGIBLE and best.error < _BETTER * agreement.error:
        mistake = (
            f"most likely {best.name}: the median error would be {best.error:.2%} instead of "
            f"{agreement.error:.2%}"
        )
    elif agreement.error > TOLERANCE:
        mistake = (
            f"the median error of depth between frames is {agreement.error:.1%}, at most "
            f"{TOLERANCE:.0%} is needed, and no known mistake explains it (the best, {best.name}, "
            f"leaves {best.error:.1%}); poses may be inaccurate, which capture.refine_poses may "
            "mend, or things may have moved"
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


def _stands_still(capture: Capture) -> bool:
    X_CW = capture.X_WCs[0].inverse()
    return all((X_CW @ X_WC).IsNearlyIdentity(1e-9) for X_WC in capture.X_WCs)
