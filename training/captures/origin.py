"""Captures far from the origin of their files' world: in national grids, UTM or Earth's center."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.far_origin import choose_origin
from splatpilot.training.captures.capture import Capture, SfmPoints


def move_origin(capture: Capture, origin: Sequence[float]) -> Capture:
    """Returns the capture in a world whose origin is at `origin` (3,) of that which it has.

    Gaussians are in single precision, in which a step is 0.06 m at 800 km. Empty, `origin` is where
    the cameras are if they are far away, and 0 otherwise.
    """
    p_WCs = np.array([X_WC.translation() for X_WC in capture.X_WCs])
    p = np.array(origin, dtype=np.float64) if origin else choose_origin(p_WCs)
    if not p.any():
        return capture
    points = capture.points
    note = f"positions are relative to {', '.join(f'{x:.10g}' for x in p)} of the files"
    return dataclasses.replace(
        capture,
        X_WCs=[RigidTransform(X.rotation(), X.translation() - p) for X in capture.X_WCs],
        points=points and SfmPoints(points.p_WQ - p, points.colors),
        notes=[*capture.notes, note],
        origin=capture.origin + p,
    )
