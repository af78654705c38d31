"""Polycam's raw data: `keyframes/` with `images/`, `cameras/` and `depth/` of a LiDAR capture.

Layout as Polycam documents it: a JSON file a keyframe with `fx`, `fy`, `cx`, `cy`, `width`,
`height` [px] and the entries `t_00` to `t_23` of the pose, which takes camera axes of OpenGL (x
right, y up, z back) to a world with y up; depth in millimetres, in fewer pixels than the image.
Where Polycam has optimised the poses they stand in `corrected_cameras/`, and images without their
distortion in `corrected_images/`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.common.readers import read_text, reason_of
from splatpilot.training.captures.capture import OPENGL_AXES, Capture, Lens, pinhole
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    FrameFiles,
    numbered_files,
    open_frames,
    pose_from_matrix,
    pose_from_quaternion,
    read_depth,
)
from splatpilot.training.captures.up_and_scale import turn_upright

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


# Record3D's export "EXR + RGB": `metadata.json`, `rgb/0.jpg`, `depth/0.exr`.
#
# As the application's author documents it: `poses` holds a row qx qy qz qw tx ty tz a frame, camera
# to world, with camera axes of OpenGL (x right, y up, z back) in a world that is the first
# camera's, so that up is not known; `K` holds the intrinsics column by column, for images of `w` x
# `h`, and `perFrameIntrinsicCoeffs`, in newer exports, fx fy cx cy of each frame; depth is in
# metres, in fewer pixels than the image.


_METADATA = "metadata.json"


def is_record3d(path: Path) -> bool:
    """Tells whether the path looks like an export of Record3D, readable or not."""
    return path.suffix == ".r3d" or ((path / _METADATA).is_file() and (path / "rgb").is_dir())


def read_record3d(path: Path, config: CaptureConfig) -> Capture:
    """Opens an export of Record3D.

    `config.intrinsics` is at the images' own size.

    Raises:
        FileNotFoundError: if there is no image.
        ValueError: if the metadata are not as they should be, too many frames cannot be used, or it
            is the application's own `.r3d`.
    """
    if path.suffix == ".r3d":
        raise ValueError(
            f"{path}: Record3D's own format, whose depth is compressed; export the recording as "
            '"EXR + RGB" and name that folder'
        )
    file = path / _METADATA
    try:
        poses, intrinsics, size = _metadata(json.loads(read_text(file)))
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{file}: not Record3D's metadata ({reason_of(error)}); `poses`, `K`, `w` and `h` are "
            "needed"
        ) from None
    images = numbered_files(path / "rgb", r"(\d+)\.(?:jpg|jpeg|png)")
    if max(images) >= len(poses):
        raise ValueError(
            f"{file}: {len(poses)} poses, but {images[max(images)].name} is frame {max(images)}; "
            "the folder and its metadata belong to different exports"
        )
    lenses: dict[bytes, Lens] = {}  # Equal cameras share one, and one resampling.

    def lens(i: int) -> Lens:
        values = np.array(config.intrinsics) if config.intrinsics else intrinsics[i]
        source = "capture.intrinsics" if config.intrinsics else _METADATA
        return lenses.setdefault(values.tobytes(), Lens(pinhole(*values), *size, source=source))

    def frame(i: int, image: Path) -> FrameFiles:
        depth, pose = path / "depth" / f"{i}.exr", np.roll(poses[i], 3)
        return FrameFiles(
            image,
            lambda: pose_from_quaternion(pose, f"{file}, frame {i}"),
            depth if depth.is_file() else None,
            lens(i),
        )

    unit = config.depth_unit or 1.0
    capture = open_frames(
        path,
        "Record3D export",
        [frame(i, image) for i, image in images.items()],
        axes=OPENGL_AXES,
        read_depth=lambda file: read_depth(file, unit),
        stretch_depth=True,
    )
    return turn_upright(capture, config.up or "cameras")


def _metadata(
    content: dict[str, Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int]]:
    """Returns the poses (N, 7), the intrinsics (N, 4) fx fy cx cy, and width and height [px]."""
    poses = np.array(content["poses"], dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise ValueError(f"poses of shape {poses.shape}, seven numbers a frame are needed")
    K = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
    intrinsics = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(poses), 1))
    own = np.array(content.get("perFrameIntrinsicCoeffs") or [], dtype=np.float64)
    if own.shape == intrinsics.shape:
        intrinsics = own
    return poses, intrinsics, (int(content["w"]), int(content["h"]))
