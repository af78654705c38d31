"""Record3D's export "EXR + RGB": `metadata.json`, `rgb/0.jpg`, `depth/0.exr`.

As the application's author documents it: `poses` holds a row qx qy qz qw tx ty tz a frame, camera
to world, with camera axes of OpenGL (x right, y up, z back) in a world that is the first camera's,
so that up is not known; `K` holds the intrinsics column by column, for images of `w` x `h`, and
`perFrameIntrinsicCoeffs`, in newer exports, fx fy cx cy of each frame; depth is in metres, in fewer
pixels than the image.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.read_limit import read_text
from splatpilot.training.captures.capture import OPENGL_AXES, Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_files import FrameFiles, open_frames
from splatpilot.training.captures.image_files import numbered_files, read_depth
from splatpilot.training.captures.lens import Lens, pinhole
from splatpilot.training.captures.poses import pose_from_quaternion
from splatpilot.training.captures.upright import turn_upright

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
