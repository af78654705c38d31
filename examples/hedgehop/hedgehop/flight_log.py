"""A capture format: the log of a drone that takes photographs in flight."""

import csv
from functools import partial
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot import Capture, register_capture
from splatpilot.training.captures.capture import FileAxes, Lens, pinhole
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import FrameFiles, open_frames, pose_from_quaternion

LOG = "flight_log.csv"
COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")

# The camera looks along the body's x axis; the body's y is left and z up, as the world's.
_AXES = FileAxes(
    "x forward, y left, z up",
    R_WF=RotationMatrix(),
    R_BC=RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])),
)


def is_flight_log(path: Path) -> bool:
    """Recognizes a folder with `flight_log.csv`."""
    return (path / LOG).exists()


def read_flight_log(path: Path, config: CaptureConfig) -> Capture:
    """Opens a log with columns `image, x, y, z, qx, qy, qz, qw` [m], named in its first line."""
    file = path / LOG
    if not config.intrinsics:
        raise ValueError(f"{path}: its intrinsics are unknown; set capture.intrinsics")
    K = pinhole(*config.intrinsics)

    def frame(row: dict[str, str], line: int) -> FrameFiles:
        def pose() -> RigidTransform:
            try:
                numbers = np.array([float(row[name]) for name in COLUMNS])
            except (KeyError, TypeError, ValueError):
                raise ValueError(f"{file}, line {line}: no pose {', '.join(COLUMNS)}") from None
            return pose_from_quaternion(numbers, f"{file}, line {line}")

        return FrameFiles(path / row["image"], pose)

    with file.open(newline="") as stream:
        frames = [frame(row, line) for line, row in enumerate(csv.DictReader(stream), start=2)]
    return open_frames(path, "flight log", frames, axes=_AXES, lens=partial(Lens, K))


FLIGHT_LOG = register_capture("flight_log", is_flight_log, read_flight_log)
