"""TartanAir sequences, V1 (`image_left/`, ...) and V2 (`image_lcam_front/`, ...).

Layout and conventions as published with the data sets (Wang et al., "TartanAir: A Dataset to Push
the Limits of Visual SLAM", IROS 2020, and TartanAir V2 after it). One line `tx ty tz qx qy qz qw` a
frame is the pose of a body (x forward, y right, z down) whose camera looks along x, in a
north-east-down world; the horizontal field of view is 90 degrees; depth is in metres along the
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
    # Our world is z up: north, west, up, with the origin of the data set's world.
    R_WF=RotationMatrix(np.diag([1.0, -1.0, -1.0])),
    # Optical axes (x right, y down, z forward) in the north-east-down body.
    R_BC=RotationMatrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
)


@dataclass(frozen=True)
class _Layout:
    kind: str
    camera: str
    depth_suffix: str
    read_depth: Callable[[Path], NDArray[np.float32]]

    @property
    def parts(self) -> tuple[str, str, str]:
        """The names of the image folder, the depth folder and the pose file."""
        return f"image_{self.camera}", f"depth_{self.camera}", f"pose_{self.camera}.txt"


_V1 = _Layout("TartanAir V1 sequence", "left", "depth.npy", lambda file: read_depth(file, unit=1))
_V2 = _Layout("TartanAir V2 sequence", "lcam_front", "depth.png", read_packed_depth)


def is_tartanair_v1(path: str | Path) -> bool:
    """Tells whether the folder looks like a TartanAir V1 sequence, whole or not."""
    return _is(_V1, Path(path))


def is_tartanair_v2(path: str | Path) -> bool:
    """Tells whether the folder looks like a TartanAir V2 sequence, whole or not."""
    return _is(_V2, Path(path))


def read_tartanair_v1(path: str | Path, config: CaptureConfig | None = None) -> Capture:
    """Opens a TartanAir V1 sequence; images and depths are loaded when asked for.

    Frame i has line i of the poses. Frames of which a file is missing or damaged, or the pose is
    none, are left out; see `frame_files`.

    Raises:
        FileNotFoundError: if the folder or one of its parts is missing.
        ValueError: if the numbers of frames and poses differ, a line of the poses is not seven
            numbers, or too many frames cannot be used. The message names the file.
    """
    return _read(_V1, Path(path), config or CaptureConfig())


def read_tartanair_v2(path: str | Path, config: CaptureConfig | None = None) -> Capture:
    """Opens the front left camera of a TartanAir V2 sequence; see `read_tartanair_v1`."""
    return _read(_V2, Path(path), config or CaptureConfig())


def _is(layout: _Layout, path: Path) -> bool:
    images, _, poses = layout.parts
    return (path / poses).exists() or (path / images).is_dir()


def _read(layout: _Layout, path: Path, config: CaptureConfig) -> Capture:
    image_folder, depth_folder, pose_file = (path / part for part in layout.parts)
    for part in (path, image_folder, depth_folder, pose_file):
        if not part.exists():
            raise FileNotFoundError(
                f"{part}: does not exist; a {layout.kind} is a folder with "
                f"{layout.parts[0]}/, {layout.parts[1]}/ and {layout.parts[2]}"
            )
    images = numbered_files(image_folder, rf"(\d+)_{layout.camera}\.png")
    depths = numbered_files(
        depth_folder, rf"(\d+)_{layout.camera}_{re.escape(layout.depth_suffix)}"
    )
    rows = read_rows(pose_file, 7, "pose; seven numbers tx ty tz qx qy qz qw are needed")
    numbers = sorted(images.keys() | depths.keys())
    extra: list[str] = []
    if len(numbers) != len(rows) and len(images) == len(rows):
        extra = [f"{depths[i]}: there is no image for it" for i in depths.keys() - images.keys()]
        numbers = list(images)
    if len(numbers) != len(rows):
        raise ValueError(
            f"{pose_file}: {len(rows)} poses for {len(images)} images and {len(depths)} depths; "
            "one line a frame is needed, or nobody can tell which pose is whose"
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
        layout.kind,
        [frame(number, i) for i, number in enumerate(numbers)],
        axes=AXES,
        lens=lens,
        intrinsics=config.intrinsics,
        read_depth=layout.read_depth,
        dropped=extra,
    )
