"""Folders as ScanNet's reader exports its scans: `color/`, `depth/`, `pose/`, `intrinsic/`.

Layout as published with the data set (Dai et al., "ScanNet", CVPR 2017), which later data sets
took over: `color/0.jpg`, `depth/0.png` in millimetres, `pose/0.txt` 4x4, camera to world, -inf
where tracking was lost, `intrinsic/intrinsic_color.txt` and `intrinsic_depth.txt` 4x4, counted from
the first pixel's centre. The axes of both cameras are the same. Up is z.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import OPTICAL_AXES, Capture, DepthCamera
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_files import FrameFiles, open_frames
from splatpilot.training.captures.image_files import numbered_files, read_depth
from splatpilot.training.captures.lens import Lens, pinhole
from splatpilot.training.captures.poses import pose_from_matrix, read_matrix
from splatpilot.training.captures.upright import turn_upright

_COLOR = Path("intrinsic", "intrinsic_color.txt")
_DEPTH = Path("intrinsic", "intrinsic_depth.txt")


def is_scannet(path: Path) -> bool:
    """Tells whether the folder looks like an exported scan of ScanNet, whole or not."""
    return (path / _COLOR).is_file() and (path / "pose").is_dir()


def read_scannet(path: Path, config: CaptureConfig) -> Capture:
    """Opens a folder as ScanNet's reader exports it.

    `config.intrinsics` and `config.depth_intrinsics` are at the images' own size, and count from
    the first pixel's corner as all of this package does.

    Raises:
        FileNotFoundError: if there is no image.
        ValueError: if the intrinsics are not as they should be, or too many frames cannot be used.
    """
    colors = numbered_files(path / "color", r"(\d+)\.(?:jpg|jpeg|png)")
    lost = [number for number in colors if _is_lost(path / "pose" / f"{number}.txt")]
    unit = config.depth_unit or 1000.0
    K_C = K_D = _intrinsics(path / _COLOR)
    if config.depth_intrinsics:
        K_D = pinhole(*config.depth_intrinsics)
    elif (path / _DEPTH).is_file():
        K_D = _intrinsics(path / _DEPTH)

    def frame(number: int, color: Path) -> FrameFiles:
        pose, depth = path / "pose" / f"{number}.txt", path / "depth" / f"{number}.png"
        return FrameFiles(
            color,
            lambda: pose_from_matrix(read_matrix(pose), str(pose)),
            depth if depth.is_file() else None,
        )

    def depth_camera(width: int, height: int) -> DepthCamera:
        K = Lens(K_D, width, height).K  # which a camera of that size can have
        return DepthCamera(K, width, height, RigidTransform())

    capture = open_frames(
        path,
        "ScanNet folder",
        [frame(number, color) for number, color in colors.items() if number not in lost],
        axes=OPTICAL_AXES,
        lens=lambda width, height: Lens(K_C, width, height, source=str(_COLOR)),
        intrinsics=config.intrinsics,
        read_depth=lambda file: read_depth(file, unit),
        depth_camera=depth_camera,
        dropped=[f"{path / 'pose'}: tracking was lost in {len(lost)} frames"] if lost else (),
    )
    return turn_upright(capture, config.up or "z")


def _is_lost(pose: Path) -> bool:
    """Tells whether a pose is there, and not finite."""
    try:
        return not np.isfinite(read_matrix(pose)).all()
    except (OSError, ValueError):
        return False


def _intrinsics(file: Path) -> NDArray[np.float64]:
    K = read_matrix(file)
    return pinhole(K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
