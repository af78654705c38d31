"""Polycam's raw data: `keyframes/` with `images/`, `cameras/` and `depth/` of a LiDAR capture.

Layout as Polycam documents it: a JSON file a keyframe with `fx`, `fy`, `cx`, `cy`, `width`,
`height` [px] and the entries `t_00` to `t_23` of the pose, which takes camera axes of OpenGL (x
right, y up, z back) to a world with y up; depth in millimetres, in fewer pixels than the image.
Where Polycam has optimised the poses they stand in `corrected_cameras/`, and images without their
distortion in `corrected_images/`.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.read_limit import read_text
from splatpilot.training.captures.capture import OPENGL_AXES, Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_files import FrameFiles, open_frames
from splatpilot.training.captures.image_files import numbered_files, read_depth
from splatpilot.training.captures.lens import Lens, pinhole
from splatpilot.training.captures.poses import pose_from_matrix
from splatpilot.training.captures.upright import turn_upright

_KEYFRAMES = "keyframes"


def is_polycam(path: Path) -> bool:
    """Tells whether the folder looks like Polycam's raw data."""
    return (path / _KEYFRAMES / "cameras").is_dir() or _corrected(path)


def read_polycam(path: Path, config: CaptureConfig) -> Capture:
    """Opens the raw data of a LiDAR capture of Polycam.

    `config.intrinsics` is at the images' own size.

    Raises:
        FileNotFoundError: if there is no keyframe.
        ValueError: if too many frames cannot be used.
    """
    prefix = "corrected_" if _corrected(path) else ""
    cameras = numbered_files(path / _KEYFRAMES / f"{prefix}cameras", r"(\d+)\.json")
    unit = config.depth_unit or 1000.0
    capture = open_frames(
        path,
        "Polycam capture",
        [_frame(path / _KEYFRAMES, prefix, camera, config) for camera in cameras.values()],
        axes=OPENGL_AXES,
        read_depth=lambda file: read_depth(file, unit),
        stretch_depth=True,
    )
    return turn_upright(capture, config.up or "y")


def _corrected(path: Path) -> bool:
    return (path / _KEYFRAMES / "corrected_cameras").is_dir()


def _frame(folder: Path, prefix: str, camera: Path, config: CaptureConfig) -> FrameFiles:
    image = folder / f"{prefix}images" / f"{camera.stem}.jpg"
    depth = folder / "depth" / f"{camera.stem}.png"
    try:
        lens, matrix = _camera(camera, config)
    except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
        message = f"{camera}: not the camera of a keyframe ({reason_of(error)}); copy it again"
        return FrameFiles(image, lambda: _refuse(message))
    return FrameFiles(
        image,
        lambda: pose_from_matrix(matrix, str(camera)),
        depth if depth.is_file() else None,
        lens,
    )


def _camera(file: Path, config: CaptureConfig) -> tuple[Lens, NDArray[np.float64]]:
    """Returns the lens of a keyframe, and its pose as a matrix (3, 4)."""
    values = json.loads(read_text(file))
    focal = config.intrinsics or [float(values[name]) for name in ("fx", "fy", "cx", "cy")]
    source = "capture.intrinsics" if config.intrinsics else f"{file.parent.name}/"
    lens = Lens(pinhole(*focal), int(values["width"]), int(values["height"]), source=source)
    entries = [float(values[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
    return lens, np.array(entries).reshape(3, 4)


def _refuse(message: str) -> RigidTransform:
    raise ValueError(message)
