"""Rolling shutters: each row of an image is seen from where the camera was when it was read.

Rows are read one after the other at even times, the first at the pose X_WC0 and the last at X_WC1,
those between at `pose_between`. Rows between which an image hardly moves are rendered together, as
a band, from the pose of their middle.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.pose_between import pose_between

_STEP = 0.5
"""[px] that an image may move between two bands, so that no row is off by more than half of it."""
_NEAREST = 1.0
"""[m] Depth of what is told to move so far; what is nearer moves more."""


def row_bands(
    X_WC0: RigidTransform, X_WC1: RigidTransform, focal: float, height: int, fewest: int = 1
) -> list[tuple[int, int]]:
    """First row and row after the last of each band of an image.

    Args:
        X_WC0, X_WC1: poses of the camera at the first and the last row.
        focal: [px]
        height: [px]
        fewest: bands at least, for what moves before a camera at rest.
    """
    turned = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis().angle()
    travelled = np.linalg.norm(X_WC1.translation() - X_WC0.translation())
    moved = focal * (abs(turned) + float(travelled) / _NEAREST)
    count = min(height, max(fewest, math.ceil(moved / _STEP)))
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(pairwise(edges))


class Band(NamedTuple):
    """Rows of an image that are rendered from one pose, as an image of their own."""

    K: NDArray[np.float64]
    """Its intrinsics (3, 3) [px]."""
    height: int
    """[px]"""
    X_WC: RigidTransform
    """Where its middle row is read."""
    s: float
    """When: 0 as the first row of all is, 1 as the last."""


def camera_bands(
    K: NDArray[np.float64],
    height: int,
    X_WC0: RigidTransform,
    X_WC1: RigidTransform,
    fewest: int = 1,
) -> Iterator[Band]:
    """The bands of an image of intrinsics K (3, 3) [px] from its first row to its last; else as
    `row_bands`."""
    focal = float(max(K[0, 0], K[1, 1]))
    for first, last in row_bands(X_WC0, X_WC1, focal, height, fewest):
        s = 0.5 * (first + last) / height
        cropped = K.copy()
        cropped[1, 2] -= first
        yield Band(cropped, last - first, pose_between(X_WC0, X_WC1, s), s)
