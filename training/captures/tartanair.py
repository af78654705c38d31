"""TartanAir sequences, V1 (`image_left/`, ...) and V2 (`image_lcam_front/`, ...).

Layout and conventions as published with the data sets (Wang et al., "TartanAir: A Dataset to Push
the Limits of Visual SLAM", IROS 2020, and TartanAir V2 after it). One line `tx ty tz qx qy qz qw` a
frame is the pose of a body (x forward, y right, z down) whose camera looks along x, in a
north-east-down world; the horizontal field of view is 90 degrees; depth is in meters along the
optical axis, in V1 an array of float32, in V2 a PNG whose four channels are the bytes of a float32.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.training.captures.capture import Capture, FileAxes, Lens, pinhole
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    FrameFiles,
    numbered_files,
    open_frames,
    pose_from_quaternion,
    read_depth,
    read_packed_depth,
    read_rows,
)

AXES = FileAxes(
    "north-east-down: camera looks along x, y right, z down",
    # The world with z up is north, west, up, with the origin of the data set's world.
    R_WF=RotationMatrix(np.diag([1.0, -1.0, -1.0])),
    # Optical axes (x right, y down, z forward) in the north-east-down body.
    R_BC=RotationMatrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
)


@dataclass(frozen=True)
class _Layout:
    name: str
    camera: str
    depth_suffix: str
    read_depth: Callable[[Path], NDArray[np.float32]]

    def parts(self, path: Path) -> tuple[Path, Path, Path]:
        """Returns the image folder, the depth folder and the pose file."""
        camera = self.camera
        return path / f"image_{camera}", path / f"depth_{camera}", path / f"pose_{camera}.txt"


_V1 = _Layout("TartanAir V1 sequence", "left", "depth.npy", lambda file: read_depth(file, unit=1))
_V2 = _Layout("TartanAir V2 sequence", "lcam_front", "depth.png", read_packed_depth)


def recognizes_tartanair_v1(path: Path) -> bool:
    """Tells whether a folder looks like a TartanAir V1 sequence, complete or not."""
    return _recognizes(_V1, path)


def recognizes_tartanair_v2(path: Path) -> bool:
    """Tells whether a folder looks like a TartanAir V2 sequence, complete or not."""
    return _recognizes(_V2, path)


def read_tartanair_v1(path: Path, config: CaptureConfig | None = None) -> Capture:
    """Opens a TartanAir V1 sequence, whose frame i has line i of the poses.

    Raises:
        ValueError, OSError: if a part is missing, the numbers of frames and poses differ, or too
            many frames cannot be used.
    """
    return _read(_V1, path, config or CaptureConfig())


def read_tartanair_v2(path: Path, config: CaptureConfig | None = None) -> Capture:
    """Opens the front left camera of a TartanAir V2 sequence; see `read_tartanair_v1`."""
    return _read(_V2, path, config or CaptureConfig())


def _recognizes(layout: _Layout, path: Path) -> bool:
    images, _, poses = layout.parts(path)
    return poses.exists() or images.is_dir()


def _read(layout: _Layout, path: Path, config: CaptureConfig) -> Capture:
    image_folder, depth_folder, pose_file = layout.parts(path)
    depth_pattern = rf"(\d+)_{layout.camera}_{re.escape(layout.depth_suffix)}"
    images = numbered_files(image_folder, rf"(\d+)_{layout.camera}\.png")
    depths = numbered_files(depth_folder, depth_pattern)
    rows = read_rows(pose_file, 7, "a pose tx ty tz qx qy qz qw")
    numbers = sorted(images.keys() | depths.keys())
    extra: list[str] = []
    if len(numbers) != len(rows) and len(images) == len(rows):
        extra = [f"{depths[i]}: has no image" for i in depths.keys() - images.keys()]
        numbers = list(images)
    if len(numbers) != len(rows):
        raise ValueError(
            f"{pose_file}: {len(rows)} poses for {len(images)} images and {len(depths)} depths; "
            "the number of lines must be that of frames"
        )

    def frame(number: int, i: int) -> FrameFiles:
        name = f"{number:06d}_{layout.camera}"
        return FrameFiles(
            images.get(number, image_folder / f"{name}.png"),
            lambda: pose_from_quaternion(rows[i], f"{pose_file}, line {i + 1}"),
            depths.get(number, depth_folder / f"{name}_{layout.depth_suffix}"),
        )

    def lens(width: int, height: int) -> Lens:
        K = pinhole(width / 2, width / 2, width / 2, height / 2)
        return Lens(K, width, height, source="TartanAir's 90 degrees of width")

    return open_frames(
        path,
        layout.name,
        [frame(number, i) for i, number in enumerate(numbers)],
        axes=AXES,
        lens=lens,
        intrinsics=config.intrinsics,
        read_depth=layout.read_depth,
        dropped=extra,
    )
