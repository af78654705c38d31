"""How well depth of one frame, carried into another, agrees with the depth that stands there.

With the right reading of a capture's files both are the same surface. The measure is the median of
|z' / z - 1| over points of many pairs of frames, z carried over and z' found.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.lens import back_project
from splatpilot.training.captures.registration import grid_step

_POINTS = 5000
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
        step = grid_step(depth, _POINTS)
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
