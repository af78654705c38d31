"""Poses of a camera on a path."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.ndimage import gaussian_filter1d

from splatpilot.systems.common.validation import require

_STEP = 0.05  # [m], of a path while it is smoothed
_ROUNDING = 0.4  # [m], standard deviation of the smoothing of corners


def poses_along(
    path: NDArray[np.float64], spacing: float, yaws: Sequence[float], pitch: float
) -> list[RigidTransform]:
    """Returns the poses X_WC of a camera that stops every `spacing` [m] on a path (N, 3) [m], with
    rounded corners, and turns to `yaws` [deg], to the left from the direction of travel, at a
    `pitch` [deg], upward. A single point is one stop that travels along x."""
    path = np.asarray(path, dtype=np.float64)
    valid = path.ndim == 2 and path.shape[1] == 3 and len(path) and np.isfinite(path).all()
    require(valid, "path", "of finite points x, y, z", f"shape {path.shape}")
    p_WP = resample(path, _STEP)
    if len(p_WP) > 1:
        # Padded point-symmetrically, so that the ends do not move.
        more = min(len(p_WP) - 1, int(4 * _ROUNDING / _STEP))
        p_WP = np.pad(p_WP, ((more, more), (0, 0)), mode="reflect", reflect_type="odd")
        p_WP = gaussian_filter1d(p_WP, _ROUNDING / _STEP, axis=0)[more : len(p_WP) - more]
    p_WP = resample(p_WP, spacing)
    tangent = np.gradient(p_WP, axis=0) if len(p_WP) > 1 else np.array([[1.0, 0, 0]])
    # On climbs the heading stays.
    level = np.linalg.norm(tangent[:, :2], axis=1) > 0.1 * np.linalg.norm(tangent, axis=1)
    last = np.maximum.accumulate(np.where(level, np.arange(len(tangent)), 0))
    headings = np.arctan2(tangent[last, 1], tangent[last, 0])
    return [
        look_along(p, heading + np.deg2rad(yaw), np.deg2rad(pitch))
        for p, heading in zip(p_WP, headings, strict=True)
        for yaw in yaws
    ]


def look_along(p_WC: NDArray[np.float64], yaw: float, pitch: float) -> RigidTransform:
    """Returns the pose X_WC of an upright camera that looks along yaw and up by pitch [rad]."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return RigidTransform(
        RotationMatrix(np.column_stack([right, np.cross(ahead, right), ahead])), p_WC
    )


def move_left(X_WC: RigidTransform, offset: float) -> RigidTransform:
    """Returns the pose moved by `offset` [m] to the camera's left, looking where it looked."""
    return RigidTransform(
        X_WC.rotation(), X_WC.translation() - offset * X_WC.rotation().matrix()[:, 0]
    )


def resample(path: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Returns points of a polyline, evenly spaced by about `spacing` [m], ends included."""
    lengths = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    if lengths[-1] == 0:
        return path[:1]
    desired = np.linspace(0, lengths[-1], max(round(lengths[-1] / spacing), 1) + 1)
    return np.stack([np.interp(desired, lengths, column) for column in path.T], axis=1)
