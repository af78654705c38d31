"""Which way is up in a capture whose files do not say."""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import Capture, FileAxes, SfmPoints
from splatpilot.training.captures.lens import back_project

# How much cameras that look level count against images that are level.
_LEVEL_GAZE = 0.01

_TRIALS = 2000
_GROUND_SHARE = 0.02
_MAX_TILT = np.deg2rad(35)


def up_of_cameras(X_WCs: list[RigidTransform]) -> NDArray[np.float64]:
    """Returns the direction (3,) that people who hold their cameras level would call up.

    Level images have horizontal x axes, so up is the direction most nearly at right angles to all
    of them. Where all cameras look the same way that leaves a choice, and among what is left it is
    the one nearest to the mean of the cameras' own up: the eigenvector of the smallest eigenvalue
    of sum x x^T + 0.01 sum (I - m m^T), with m that mean's direction.
    """
    R = np.array([X_WC.rotation().matrix() for X_WC in X_WCs])
    mean = -R[:, :, 1].mean(axis=0)
    if np.linalg.norm(mean) < 0.1:
        raise ValueError(
            "the cameras have no direction in common that could be up; set capture.up to ground "
            "or to an axis of the files' world"
        )
    mean /= np.linalg.norm(mean)
    cost = np.einsum("ni,nj->ij", R[:, :, 0], R[:, :, 0])
    cost += _LEVEL_GAZE * len(R) * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(cost)[1][:, 0]
    return up if up @ mean > 0 else -up


def fit_ground(
    p_WQ: NDArray[np.float64], p_WCs: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Fits the plane n.p = d that is the ground.

    Of planes through three random points whose normal is within 35 degrees of `up` and which lie
    below the median camera, the one with the most points near it wins, where a point lower than it
    counts against it: under the ground there is nothing. Near is 2 % of the cameras' median
    distance from the points. The winner is refined by least squares.

    Args:
        p_WQ: (N, 3), points of the place.
        p_WCs: (M, 3), cameras.
        up: (3,), roughly.

    Returns:
        n (3,), upward unit normal, and d.

    Raises:
        ValueError: if no plane holds a fiftieth of the points.
    """
    rng = np.random.default_rng(0)
    camera = np.median(p_WCs, axis=0)
    reach = np.linalg.norm(p_WQ - camera, axis=1)
    near = 0.02 * float(np.median(reach))
    # Far points are few and inaccurate.
    p_WQ = p_WQ[reach < 3 * np.median(reach)]
    if len(p_WQ) > 20_000:
        p_WQ = p_WQ[rng.choice(len(p_WQ), 20_000, replace=False)]
    best, best_count = None, 0.0
    sample = rng.choice(len(p_WQ), (_TRIALS, 3)) if len(p_WQ) >= 3 else np.empty((0, 3), int)
    for a, b, c in p_WQ[sample]:
        n = np.cross(b - a, c - a)
        if (length := np.linalg.norm(n)) == 0:
            continue
        n *= np.sign(n @ up) / length
        height = p_WQ @ n - n @ a
        if n @ up < np.cos(_MAX_TILT) or n @ camera <= n @ a:
            continue
        count = float((np.abs(height) < near).sum() - (height < -2 * near).sum())
        if count > best_count:
            best, best_count = (n, n @ a), count
    if best is None or best_count < _GROUND_SHARE * len(p_WQ):
        raise ValueError(
            "no ground was found: no plane below the cameras holds a fiftieth of the points; give "
            "the scale or the up direction in another way"
        )
    n, d = best
    for width in near * np.array([1, 0.5, 0.25, 0.125]):
        # Narrower each time, so that the feet of walls count less.
        inliers = p_WQ[np.abs(p_WQ @ n - d) < width]
        if len(inliers) < 10:
            break
        center = inliers.mean(axis=0)
        n = np.linalg.svd(inliers - center, full_matrices=False)[2][2]
        n = n if n @ up > 0 else -n
        d = n @ center
    return n, float(d)


def turn_upright(capture: Capture, up: str) -> Capture:
    """Turns the world of a capture so that z is up.

    Args:
        up: x, y, z, -x, -y or -z of the present world, `cameras` or `ground`; see
            `up_of_cameras` and `fit_ground`, which takes points or, without them, depth.

    Raises:
        ValueError: if no up direction can be found.
    """
    if up == "z":
        return capture
    if up in ("cameras", "ground"):
        direction = up_of_cameras(list(capture.X_WCs))
        if up == "ground":
            cameras = np.array([X_WC.translation() for X_WC in capture.X_WCs])
            direction, _ = fit_ground(known_points(capture), cameras, direction)
    else:
        direction = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    return turn_and_scale(capture, _turn_to_z(direction))


def turn_and_scale(capture: Capture, R_NW: RotationMatrix, scale: float = 1.0) -> Capture:
    """Returns the capture in a world N, turned and with lengths times `scale`; not its depth."""
    points, axes = capture.points, capture.axes
    return dataclasses.replace(
        capture,
        X_WCs=[
            RigidTransform(R_NW @ X.rotation(), scale * R_NW.multiply(X.translation()))
            for X in capture.X_WCs
        ],
        points=points and SfmPoints(scale * points.p_WQ @ R_NW.matrix().T, points.colors),
        axes=axes and FileAxes(axes.name, R_NW @ axes.R_WF, axes.R_BC),
    )


def known_points(capture: Capture) -> NDArray[np.float64]:
    """Returns points (N, 3) of the place: those known or, without them, of up to 20 depth images.

    Raises:
        ValueError: if there are neither.
    """
    if capture.points is not None:
        return capture.points.p_WQ
    parts = []
    for i in np.unique(np.linspace(0, len(capture) - 1, 20).astype(int)).tolist():
        depth = capture.registered_depth(i)[::16, ::16]
        rows, columns = np.nonzero((depth > 0) & np.isfinite(depth))
        p_CQ = back_project(capture.K, 16 * columns + 0.5, 16 * rows + 0.5, depth[rows, columns])
        parts.append(capture.X_WCs[i].multiply(p_CQ.T).T)
    if not sum(len(part) for part in parts):
        raise ValueError(
            f"{capture.source}: neither points nor depth are known, so no ground can be found; set "
            "capture.up or capture.scale in another way"
        )
    return np.concatenate(parts)


def _turn_to_z(up: NDArray[np.float64]) -> RotationMatrix:
    """Returns the smallest rotation that takes the unit vector `up` to z."""
    z = np.array([0.0, 0.0, 1.0])
    if up @ z < -1 + 1e-12:
        return RotationMatrix(np.diag([1.0, -1.0, -1.0]))
    v = np.cross(up, z)
    V = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return RotationMatrix.ProjectToRotationMatrix(np.eye(3) + V + V @ V / (1 + up @ z))
