"""How captures that were registered from images alone become metric."""

import dataclasses
from collections.abc import Callable
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import ScaleConfig
from splatpilot.training.captures.upright import (
    fit_ground,
    known_points,
    turn_and_scale,
    up_of_cameras,
)

_FEWEST = 20
"""Points whose depth must be known for a scale."""
_MAX_TILT = 10.0
"""[deg] of a ground against what level cameras call level."""
_MAX_SPREAD = 0.25
"""Of the cameras' heights over a ground, 10 to 90 %, relative to their median."""


def make_metric(
    capture: Capture,
    scale: ScaleConfig,
    locate: Callable[[str, NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> Capture:
    """Gives a capture in unknown units its scale, or marks it as not metric if `scale` has none.

    Args:
        capture: its depth, if any, is in metres already; its poses and points are not.
        scale: where metres come from.
        locate: returns the point (3,) that is seen in the image of a name at a pixel (2,), or
            raises ValueError; None if pixels cannot be located.

    Raises:
        ValueError: if the scale cannot be had in the way that is asked for.
    """
    given = scale.given()
    if not given:
        return dataclasses.replace(capture, metric=False)
    if scale.factor:
        factor = scale.factor
    elif scale.distance:
        a, b = (_locate(capture, each, locate) for each in scale.between)
        if (length := float(np.linalg.norm(a - b))) < 1e-9:
            raise ValueError(f"scale.between: {' and '.join(scale.between)} are the same place")
        factor = scale.distance / length
    elif scale.camera_height:
        factor = scale.camera_height / camera_height(capture)
    else:
        factor = _factor_from_depth(capture)
    source = f"{capture.source}, scale {factor:.6g} from {given[0]}"
    return dataclasses.replace(turn_and_scale(capture, RotationMatrix(), factor), source=source)


def _locate(
    capture: Capture,
    what: str,
    locate: Callable[[str, NDArray[np.float64]], NDArray[np.float64]] | None,
) -> NDArray[np.float64]:
    """Returns the camera ("a.jpg") or the point ("a.jpg@812,344") that is meant, (3,)."""
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
        raise ValueError(f"scale.between: {what!r}: this kind of capture knows only cameras")
    try:
        u, v = (float(x) for x in pixel.split(","))
    except ValueError:
        raise ValueError(f"scale.between: {what!r} does not end in a pixel: @u,v") from None
    return locate(names[found[0]], np.array([u, v]))


def camera_height(capture: Capture) -> float:
    """Returns the median height of the cameras above the ground, in the capture's units.

    Raises:
        ValueError: if no ground can be found, see `fit_ground` and `known_points`; or if it is
            none that the cameras were carried over at one height, each about level.
    """
    cameras = np.array([X_WC.translation() for X_WC in capture.X_WCs])
    up = up_of_cameras(list(capture.X_WCs))
    n, d = fit_ground(known_points(capture), cameras, up)
    tilt = float(np.rad2deg(np.arccos(min(n @ up, 1.0))))
    low, median, high = np.quantile(cameras @ n - d, [0.1, 0.5, 0.9])
    if tilt > _MAX_TILT or not high - low < _MAX_SPREAD * median:
        raise ValueError(
            f"{capture.source}: what looks most like ground tilts by {tilt:.0f} degrees against "
            f"the cameras (at most {_MAX_TILT:g} are believed), which are {low:.3g} to {high:.3g} "
            f"units above it, {median:.3g} in the middle (at most {_MAX_SPREAD:.0%} of it apart); "
            "a height gives no scale; measure a length: scale.between and scale.distance"
        )
    return float(median)


def _factor_from_depth(capture: Capture) -> float:
    """Returns the median ratio of measured depth to that of the points, over all images with depth.

    A point that is hidden in an image has a ratio too small; the median bears that while fewer
    than half are.
    """
    ratios = []
    points = capture.points
    for i in range(len(capture) if points is not None and capture.has_depth else 0):
        depth = capture.registered_depth(i)
        x, y, z = capture.X_WCs[i].inverse().multiply(points.p_WQ.T)  # pyright: ignore
        with np.errstate(divide="ignore", invalid="ignore"):
            u = capture.K[0, 0] * x / z + capture.K[0, 2]
            v = capture.K[1, 1] * y / z + capture.K[1, 2]
        seen = (z > 0) & (u >= 0) & (u < capture.width) & (v >= 0) & (v < capture.height)
        measured = depth[v[seen].astype(int), u[seen].astype(int)]
        known = (measured > 0) & np.isfinite(measured)
        ratios.append(measured[known] / z[seen][known])
    ratio = np.concatenate(ratios) if ratios else np.zeros(0)
    if len(ratio) < _FEWEST:
        raise ValueError(
            f"scale.depth_folder: {len(ratio)} points have a measured depth, at least {_FEWEST} "
            "are needed; is there a depth file for each of some images, of its name and in its "
            "subfolder?"
        )
    return float(np.median(ratio))
