"""TartanAir sequences, V1 (`image_left/`, ...) and V2 (`image_lcam_front/`, ...).

As published (Wang et al., "TartanAir: A Dataset to Push the Limits of Visual SLAM", IROS 2020): one
line `tx ty tz qx qy qz qw` a frame is the pose of a body (x forward, y right, z down) whose camera
looks along x, in a north-east-down world; images are 90 degrees wide; depth [m] is along the
optical axis, in V1 an array, in V2 a PNG whose four channels are the bytes of a float32.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.training.captures import frames
from splatpilot.training.captures.capture import Capture, FileAxes, Lens, pinhole
from splatpilot.training.captures.capture_config import CaptureConfig

AXES = FileAxes(
    "north-east-down: camera looks along x, y right, z down",
    # The world with z up is north, west, up, with the origin of the data set's world.
    R_WF=RotationMatrix(np.diag([1.0, -1.0, -1.0])),
    # Optical axes (x right, y down, z forward) in the north-east-down body.
    R_BC=RotationMatrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
)
_CAMERAS = {"V1": "left", "V2": "lcam_front"}


def recognizes(path: Path, version: str) -> bool:
    """Tells whether a folder looks like a TartanAir sequence of "V1" or "V2", complete or not."""
    camera = _CAMERAS[version]
    return (path / f"pose_{camera}.txt").exists() or (path / f"image_{camera}").is_dir()


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """Returns the intrinsics (3, 3) [px] of a camera 90 degrees wide."""
    return pinhole(width / 2, width / 2, width / 2, height / 2)


def read(path: Path, config: CaptureConfig, version: str) -> Capture:
    """Opens a TartanAir sequence, of V2 its front left camera. Frame i has line i of the poses."""
    camera = _CAMERAS[version]
    suffix = "depth.npy" if version == "V1" else "depth.png"
    image_folder, depth_folder = path / f"image_{camera}", path / f"depth_{camera}"
    pose_file = path / f"pose_{camera}.txt"
    images = frames.numbered_files(image_folder, rf"(\d+)_{camera}\.png")
    depths = frames.numbered_files(depth_folder, rf"(\d+)_{camera}_{re.escape(suffix)}")
    rows = frames.read_rows(pose_file, 7, "a pose tx ty tz qx qy qz qw")
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

    def frame(number: int, i: int) -> frames.FrameFiles:
        name = f"{number:06d}_{camera}"
        return frames.FrameFiles(
            images.get(number, image_folder / f"{name}.png"),
            lambda: frames.pose_from_quaternion(rows[i], f"{pose_file}, line {i + 1}"),
            depths.get(number, depth_folder / f"{name}_{suffix}"),
        )

    return frames.open_frames(
        path,
        f"TartanAir {version} sequence",
        [frame(number, i) for i, number in enumerate(numbers)],
        axes=AXES,
        config=config,
        lens=lambda *size: Lens(intrinsics(*size), *size, source="TartanAir's 90 degrees of width"),
        depth_unit=1.0,
        read_depth=frames.read_depth if version == "V1" else frames.read_packed_depth,
        dropped=extra,
    )
