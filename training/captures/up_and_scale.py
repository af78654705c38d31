"""Up direction, metric scale and origin of a capture whose files leave them open."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.systems.splats.scene import choose_origin
from splatpilot.training.captures.capture import (
    Capture,
    FileAxes,
    SfmPoints,
    depth_points,
    project_points,
)
from splatpilot.training.captures.capture_config import ScaleConfig

_LEVEL_GAZE = 0.01  # weight of cameras that look level against images that are level
_TRIALS = 2000
_GROUND_SHARE = 0.02
_MAX_TILT = np.deg2rad(35)
_MIN_POINTS = 20  # points whose depth must be known for a scale
_MAX_SCALE_TILT = 10.0  # [deg] of a ground against what level cameras call level
_MAX_SPREAD = 0.25  # of the cameras' heights over a ground, 10 to 90 %, relative to their median


def up_of_cameras(X_WCs: Sequence[RigidTransform]) -> NDArray[np.float64]:
    """Returns the up direction (3,) of cameras that are held level: at right angles to their x axes
    and near the mean m of their own up, the eigenvector of the smallest eigenvalue of
    sum x x^T + 0.01 sum (I - m m^T)."""
    R = np.array([X_WC.rotation().matrix() for X_WC in X_WCs])
    mean = -R[:, :, 1].mean(axis=0)
    if np.linalg.norm(mean) < 0.1:
        raise ValueError(
            "the cameras have no common up direction; set capture.up to ground or to an axis of "
            "the files' world"
        )
    mean /= np.linalg.norm(mean)
    cost = np.einsum("ni,nj->ij", R[:, :, 0], R[:, :, 0])
    cost += _LEVEL_GAZE * len(R) * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(cost)[1][:, 0]
    return up if up @ mean > 0 else -up


def fit_ground(
    p_WQ: NDArray[np.float64], p_WCs: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Fits the ground plane n.p = d to points (N, 3), and returns n (3,), upward, and d.

    Of planes through three random points, within 35 degrees of `up` and below the median camera,
    the one with the most points within 2 % of the median distance wins, less those below it; it is
    refined by least squares.
    """
    rng = np.random.default_rng(0)
    camera = np.median(p_WCs, axis=0)
    reach = np.linalg.norm(p_WQ - camera, axis=1)
    near = 0.02 * float(np.median(reach))
    # Far points are few and inaccurate.
    p_WQ = p_WQ[reach < 3 * np.median(reach)]
    if len(p_WQ) > 20_000:
        p_WQ = p_WQ[rng.choice(len(p_WQ), 20_000, replace=False)]
    sample = p_WQ[rng.choice(len(p_WQ), (_TRIALS, 3))] if len(p_WQ) else np.zeros((0, 3, 3))
    a, b, c = np.moveaxis(sample, 1, 0)
    normals = np.cross(b - a, c - a)
    normals *= np.sign(normals @ up[:, None]) / (np.linalg.norm(normals, axis=1)[:, None] + 1e-300)
    offsets = (normals * a).sum(axis=1)
    steep, below = normals @ up < np.cos(_MAX_TILT), normals @ camera > offsets

    def score(plane: int) -> float:
        height = p_WQ @ normals[plane] - offsets[plane]
        return float((np.abs(height) < near).sum() - (height < -2 * near).sum())

    best = max(np.flatnonzero(below & ~steep).tolist(), key=score, default=None)
    if best is None or score(best) < max(_GROUND_SHARE * len(p_WQ), 1):
        raise ValueError(
            "no ground was found: no plane below the cameras holds a fiftieth of the points; "
            "choose another capture.up, or another field of capture.scale"
        )
    n, d = normals[best], offsets[best]
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
    """Rotates the world of a capture so that z is up. `up` is x, y, z, -x, -y or -z of the present
    world, `cameras` or `ground`; see `up_of_cameras` and `fit_ground`."""
    if up == "z":
        return capture
    if up in ("cameras", "ground"):
        direction = up_of_cameras(capture.X_WCs)
        if up == "ground":
            cameras = np.array([X_WC.translation() for X_WC in capture.X_WCs])
            direction, _ = fit_ground(_known_points(capture), cameras, direction)
    else:
        direction = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    # The smallest rotation that takes it to z.
    axis = np.cross(direction, [0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis) if axis.any() else np.array([1.0, 0.0, 0.0])
    turn = Rotation.from_rotvec(np.arccos(np.clip(direction[2], -1, 1)) * axis)
    return _transform(capture, RotationMatrix(turn.as_matrix()))


def _transform(
    capture: Capture,
    R_NW: RotationMatrix,
    scale: float = 1.0,
    p_WN: NDArray[np.float64] | float = 0.0,
    **changes: Any,
) -> Capture:
    """Returns the capture in a world N with origin p_WN and other units; its depth stays."""
    points, axes = capture.points, capture.axes
    return dataclasses.replace(
        capture,
        X_WCs=[
            RigidTransform(R_NW @ X.rotation(), scale * R_NW.multiply(X.translation() - p_WN))
            for X in capture.X_WCs
        ],
        points=points and SfmPoints(scale * (points.p_WQ - p_WN) @ R_NW.matrix().T, points.colors),
        axes=FileAxes(axes.name, R_NW @ axes.R_WF, axes.R_BC),
        **changes,
    )


def _known_points(capture: Capture) -> NDArray[np.float64]:
    """Returns points (N, 3) of the scene: the capture's or, without them, of 20 depth images."""
    if capture.points is not None:
        return capture.points.p_WQ
    parts = []
    for i in np.unique(np.linspace(0, len(capture) - 1, 20).astype(int)).tolist():
        p_CQ, _, _ = depth_points(capture.K, capture.registered_depth(i), step=16)
        parts.append(capture.X_WCs[i].multiply(p_CQ.T).T)
    if not sum(len(part) for part in parts):
        raise ValueError(
            f"{capture.source}: has neither points nor depth to find the ground; choose another "
            "capture.up, or another field of capture.scale"
        )
    return np.concatenate(parts)


def make_metric(
    capture: Capture,
    scale: ScaleConfig,
    locate: Callable[[str, NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> Capture:
    """Scales poses and points in unknown units to meters, or marks the capture as not metric.
    `locate`, if given, returns the point (3,) that the image of a name shows at a pixel (2,)."""
    sources = scale.sources()
    if not sources:
        return dataclasses.replace(capture, metric=False)
    if scale.factor:
        factor = scale.factor
    elif scale.distance:
        a, b = (_locate(capture, each, locate) for each in scale.between)
        if (length := float(np.linalg.norm(a - b))) < 1e-9:
            raise ValueError(f"scale.between: {' and '.join(scale.between)} are the same point")
        factor = scale.distance / length
    elif scale.camera_height:
        factor = scale.camera_height / camera_height(capture)
    else:
        factor = _factor_from_depth(capture)
    source = f"{capture.source}, scale {factor:.6g} from {sources[0]}"
    return _transform(capture, RotationMatrix(), factor, source=source)


def _locate(
    capture: Capture,
    what: str,
    locate: Callable[[str, NDArray[np.float64]], NDArray[np.float64]] | None,
) -> NDArray[np.float64]:
    """Returns the position (3,) of a camera ("a.jpg") or of a point ("a.jpg@812,344")."""
    name, at, pixel = what.partition("@")
    names, parts = list(capture.frame_names), PurePath(name).parts
    found = [i for i, each in enumerate(names) if PurePath(each).parts == parts] or [
        i for i, each in enumerate(names) if PurePath(each).parts[-len(parts) :] == parts
    ]
    if len(found) != 1:
        known = ", ".join(names[i] for i in found[:5]) or f"{', '.join(names[:5])}, ..."
        how = "several registered images are" if found else "no registered image is"
        raise ValueError(f"scale.between: {how} called {name!r}; choose one of {known}")
    if not at:
        return capture.X_WCs[found[0]].translation()
    if locate is None:
        raise ValueError(f"scale.between: {what!r}: this capture format knows only cameras")
    try:
        u, v = (float(x) for x in pixel.split(","))
    except ValueError:
        raise ValueError(f"scale.between: {what!r} does not end in a pixel: @u,v") from None
    return locate(names[found[0]], np.array([u, v]))


def camera_height(capture: Capture) -> float:
    """Returns the median height of level cameras above the ground, in the capture's units."""
    cameras = np.array([X_WC.translation() for X_WC in capture.X_WCs])
    up = up_of_cameras(capture.X_WCs)
    n, d = fit_ground(_known_points(capture), cameras, up)
    tilt = float(np.rad2deg(np.arccos(min(n @ up, 1.0))))
    low, median, high = np.quantile(cameras @ n - d, [0.1, 0.5, 0.9])
    if tilt > _MAX_SCALE_TILT or not high - low < _MAX_SPREAD * median:
        raise ValueError(
            f"{capture.source}: the most likely ground tilts by {tilt:.0f} degrees against the "
            f"cameras (at most {_MAX_SCALE_TILT:g}), which are {low:.3g} to {high:.3g} units above "
            f"it, {median:.3g} in the middle (at most {_MAX_SPREAD:.0%} of it apart); give a "
            "length instead: scale.between and scale.distance"
        )
    return float(median)


def _factor_from_depth(capture: Capture) -> float:
    """Returns the median ratio of measured depth to that of the points; few are hidden."""
    ratios = [np.zeros(0)]
    points = capture.points.p_WQ if capture.points is not None else np.zeros((0, 3))
    for i in range(len(capture) if capture.has_depth and len(points) else 0):
        p_CQ = capture.X_WCs[i].inverse().multiply(points.T).T
        inside, rows, columns = project_points(capture.K, p_CQ, capture.width, capture.height)
        measured = capture.registered_depth(i)[rows, columns]
        known = (measured > 0) & np.isfinite(measured)
        ratios.append(measured[known] / p_CQ[inside, 2][known])
    ratio = np.concatenate(ratios)
    if len(ratio) < _MIN_POINTS:
        raise ValueError(
            f"scale.depth_folder: {len(ratio)} points have a measured depth, at least "
            f"{_MIN_POINTS} must; depth files must have the names and subfolders of their images"
        )
    return float(np.median(ratio))


def move_origin(capture: Capture, origin: Sequence[float]) -> Capture:
    """Returns the capture in a world whose origin is at `origin` (3,) of its present one; if empty,
    in the middle of cameras that are too far away for single precision."""
    p_WCs = np.array([X_WC.translation() for X_WC in capture.X_WCs])
    p = np.array(origin, dtype=np.float64) if origin else choose_origin(p_WCs)
    if not p.any():
        return capture
    note = f"positions are relative to {', '.join(f'{x:.10g}' for x in p)} of the files"
    changes = {"notes": [*capture.notes, note], "origin": capture.origin + p}
    return _transform(capture, RotationMatrix(), p_WN=p, **changes)
