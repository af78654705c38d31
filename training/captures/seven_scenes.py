"""RGB-D folders of the 7-Scenes kind: `frame-%06d.color.png`, `.depth.png`, `.pose.txt`.

Layout as published with the data set (Shotton et al., "Scene Coordinate Regression Forests", CVPR
2013): depth in millimetres with 0 and 65535 invalid; poses 4x4, camera to world, of the depth
camera, whose intrinsics are published: 585 px at the centre of 640x480. Colour comes from another
camera, which the data set does not calibrate. What is used here unless the configuration says
otherwise was measured on redkitchen by agreement of colours between frames.
"""

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import OPTICAL_AXES, Capture, DepthCamera
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_files import FrameFiles, open_frames
from splatpilot.training.captures.image_files import numbered_files, read_depth
from splatpilot.training.captures.lens import Lens, pinhole
from splatpilot.training.captures.poses import pose_from_matrix, read_matrix
from splatpilot.training.captures.upright import turn_upright

# fx, fy, cx, cy [px] at 640x480, and the colour camera's position in the depth camera [m].
_COLOR = (523.0, 523.0, 320.0, 240.0)
_DEPTH = (585.0, 585.0, 320.0, 240.0)
_P_DC = (0.024, 0.005, 0.0)

_COLOR_NAME = r"frame-(\d+)\.color\.(?:jpg|jpeg|png)"


def is_seven_scenes(path: Path) -> bool:
    """Tells whether the folder holds frames named as in 7-Scenes."""
    return next(path.glob("frame-*.color.*"), None) is not None


def read_seven_scenes(path: Path, config: CaptureConfig) -> Capture:
    """Opens an RGB-D folder of the 7-Scenes kind.

    `config.intrinsics` and `config.depth_intrinsics` are at the images' own size. Setting
    `intrinsics` and `depth_intrinsics` equal with `p_DC` zero says that depth is registered.

    Raises:
        FileNotFoundError: if there is no colour image.
        ValueError: if too many frames cannot be used.
    """
    colors = numbered_files(path, _COLOR_NAME)
    unit = config.depth_unit or 1000.0
    X_DC = RigidTransform(np.array(config.p_DC or _P_DC))

    def frame(number: int, color: Path) -> FrameFiles:
        stem = color.name.partition(".")[0]
        pose = path / f"{stem}.pose.txt"

        def X_FC() -> RigidTransform:
            return pose_from_matrix(read_matrix(pose), str(pose)) @ X_DC

        return FrameFiles(color, X_FC, path / f"{stem}.depth.png")

    def lens(width: int, height: int) -> Lens:
        source = "what was measured on redkitchen: set capture.intrinsics if the camera is another"
        return Lens(pinhole(*_COLOR), 640, 480, source=source).scale_to(width, height)

    def depth_camera(width: int, height: int) -> DepthCamera:
        if config.depth_intrinsics:
            K = pinhole(*config.depth_intrinsics)
        else:
            K = Lens(pinhole(*_DEPTH), 640, 480).scale_to(width, height).K
        return DepthCamera(K, width, height, X_DC.inverse())

    capture = open_frames(
        path,
        "RGB-D folder",
        [frame(number, color) for number, color in colors.items()],
        axes=OPTICAL_AXES,
        lens=lens,
        intrinsics=config.intrinsics,
        read_depth=lambda file: read_depth(file, unit),
        depth_camera=depth_camera,
    )
    return turn_upright(capture, config.up or "cameras")
