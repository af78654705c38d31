"""The readings of a capture's files with one known mistake each undone."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import minimize

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.frame_agreement import FramePair, Reading, measure_reading

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
