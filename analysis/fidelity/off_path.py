"""Poses beside a capture's path, and frames of it that are withheld to stand for them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import Capture, no_depth


def choose_withheld(frames: int, stretches: Sequence[int], kept: int) -> list[int]:
    """Returns the frames to withhold: stretches of these lengths in turn, over and over, with
    `kept` frames before, between and after them.

    Raises:
        ValueError: if not even one stretch fits.
    """
    withheld: list[int] = []
    start = kept
    for length in cycle(stretches):
        if start + length + kept > frames:
            break
        withheld += range(start, start + length)
        start += length + kept
    if not withheld:
        raise ValueError(
            f"{frames} frames are too few to withhold {stretches[0]} between {kept} that are kept; "
            "withhold shorter stretches"
        )
    return withheld


def drop_frames(capture: Capture, withheld: Sequence[int]) -> Capture:
    """Returns the capture less some of its frames."""
    gone = set(withheld)
    kept = [i for i in range(len(capture)) if i not in gone]
    return replace(
        capture,
        X_WCs=[capture.X_WCs[i] for i in kept],
        load_image=lambda k: capture.load_image(kept[k]),
        load_depth=(lambda k: capture.load_depth(kept[k])) if capture.has_depth else no_depth,
        load_valid=lambda k: capture.load_valid(kept[k]),
        held_out=None,
        frame_names=[capture.frame_names[i] for i in kept] if capture.frame_names else (),
        folder="",
    )


def displace_pose(
    X_WCs: Sequence[RigidTransform], i: int, offset: float
) -> tuple[RigidTransform, RigidTransform, RigidTransform, RigidTransform]:
    """Returns pose i of a path moved by `offset` [m] to its left, to its right, up and down.

    Left is horizontal and at right angles to the way the path goes there; where it stands still or
    goes up and down, it is along the camera's x axis.
    """
    before, after = X_WCs[max(i - 1, 0)], X_WCs[min(i + 1, len(X_WCs) - 1)]
    way = after.translation() - before.translation()
    left = np.array([-way[1], way[0], 0.0])
    if np.linalg.norm(left) < 0.5 * np.linalg.norm(way) or not way.any():
        left = -X_WCs[i].rotation().matrix()[:, 0]
    left = offset * left / np.linalg.norm(left)
    up = np.array([0.0, 0.0, offset])
    R_WC, p_WC = X_WCs[i].rotation(), X_WCs[i].translation()
    steps = (left, -left, up, -up)
    a, b, c, d = (RigidTransform(R_WC, p_WC + step) for step in steps)
    return a, b, c, d
