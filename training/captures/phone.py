"""LiDAR captures of phones: Polycam's raw data and exports of Record3D."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.common.readers import read_text, reason_of
from splatpilot.systems.common.validation import require
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
_METADATA = "metadata.json"


def recognizes_polycam(path: Path) -> bool:
    """Tells whether a folder looks like Polycam's raw data."""
    return (path / _KEYFRAMES / "cameras").is_dir() or _is_corrected(path)


def read_polycam(path: Path, config: CaptureConfig) -> Capture:
    """Opens the raw data of a LiDAR capture of Polycam, as it documents them.

    `keyframes/` holds `images/`, `depth/` and `cameras/`, a JSON file per keyframe with `fx`, `fy`,
    `cx`, `cy`, `width`, `height` [px] and the entries `t_00` to `t_23` of the pose, from camera
    axes of OpenGL to a world with y up; depth is in millimeters, in fewer pixels than the image.
    `corrected_cameras/` and `corrected_images/` hold optimized poses and undistorted images.

    Raises:
        ValueError, OSError: if there is no keyframe, or too many frames cannot be used.
    """
    folder, prefix = path / _KEYFRAMES, "corrected_" if _is_corrected(path) else ""
    unit = config.depth_unit or 1000.0

    def frame(camera: Path) -> FrameFiles:
        def X_FB() -> RigidTransform:
            if problem:
                raise ValueError(problem)
            return pose_from_matrix(np.array(matrix).reshape(3, 4), str(camera))

        lens, matrix, problem = None, [], ""
        try:
            values = json.loads(read_text(camera))
            focal = config.intrinsics or [float(values[name]) for name in ("fx", "fy", "cx", "cy")]
            source = "capture.intrinsics" if config.intrinsics else f"{camera.parent.name}/"
            size = int(values["width"]), int(values["height"])
            lens = Lens(pinhole(*focal), *size, source=source)
            matrix = [float(values[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            problem = f"{camera}: not the camera of a keyframe ({reason_of(error)}); copy it again"
        image = folder / f"{prefix}images" / f"{camera.stem}.jpg"
        depth = folder / "depth" / f"{camera.stem}.png"
        return FrameFiles(image, X_FB, depth if depth.is_file() else None, lens)

    cameras = numbered_files(folder / f"{prefix}cameras", r"(\d+)\.json")
    capture = open_frames(
        path,
        "Polycam capture",
        [frame(camera) for camera in cameras.values()],
        axes=OPENGL_AXES,
        read_depth=lambda file: read_depth(file, unit),
        stretch_depth=True,
    )
    return turn_upright(capture, config.up or "y")


def _is_corrected(path: Path) -> bool:
    return (path / _KEYFRAMES / "corrected_cameras").is_dir()


def recognizes_record3d(path: Path) -> bool:
    """Tells whether a path looks like an export of Record3D, readable or not."""
    return path.suffix == ".r3d" or ((path / _METADATA).is_file() and (path / "rgb").is_dir())


def read_record3d(path: Path, config: CaptureConfig) -> Capture:
    """Opens an export "EXR + RGB" of Record3D: `metadata.json`, `rgb/0.jpg`, `depth/0.exr`.

    As the application's author documents it, `poses` holds a row qx qy qz qw tx ty tz per frame,
    from camera axes of OpenGL to the first camera's, so that up is unknown; `K` holds the
    intrinsics column by column for images of `w` x `h`, and `perFrameIntrinsicCoeffs`, in newer
    exports, fx fy cx cy of each frame; depth is in meters, in fewer pixels than the image.

    Raises:
        ValueError, OSError: if there is no image, the metadata are invalid, too many frames cannot
            be used, or it is the application's own `.r3d`.
    """
    if path.suffix == ".r3d":
        raise ValueError(
            f"{path}: Record3D's own format, whose depth is compressed; export the recording as "
            '"EXR + RGB" and name that folder'
        )
    file = path / _METADATA
    try:
        poses, intrinsics, size = _read_metadata(json.loads(read_text(file)))
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{file}: invalid metadata of Record3D ({reason_of(error)})") from None
    images = numbered_files(path / "rgb", r"(\d+)\.(?:jpg|jpeg|png)")
    if max(images) >= len(poses):
        raise ValueError(
            f"{file}: {len(poses)} poses, but {images[max(images)].name} is frame {max(images)}; "
            "the folder and its metadata belong to different exports"
        )
    lenses: dict[bytes, Lens] = {}  # Equal cameras share one, and one resampling.

    def frame(i: int, image: Path) -> FrameFiles:
        values = np.array(config.intrinsics) if config.intrinsics else intrinsics[i]
        source = "capture.intrinsics" if config.intrinsics else _METADATA
        lens = Lens(pinhole(*values), *size, source=source)
        depth, pose = path / "depth" / f"{i}.exr", np.roll(poses[i], 3)
        return FrameFiles(
            image,
            lambda: pose_from_quaternion(pose, f"{file}, frame {i}"),
            depth if depth.is_file() else None,
            lenses.setdefault(values.tobytes(), lens),
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


def _read_metadata(
    content: dict[str, Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int]]:
    """Returns the poses (N, 7), the intrinsics (N, 4) fx fy cx cy, and width and height [px]."""
    poses = np.array(content["poses"], dtype=np.float64)
    require(poses.ndim == 2 and poses.shape[1] == 7, "poses", "of shape (N, 7)", poses.shape)
    K = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
    intrinsics = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(poses), 1))
    own = np.array(content.get("perFrameIntrinsicCoeffs") or [], dtype=np.float64)
    if own.shape == intrinsics.shape:
        intrinsics = own
    return poses, intrinsics, (int(content["w"]), int(content["h"]))
