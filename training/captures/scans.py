"""ScanNet and 7-Scenes: RGB-D scans with a color camera apart from the depth camera."""

from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures import frames
from splatpilot.training.captures.capture import (
    OPTICAL_AXES,
    Capture,
    DepthCamera,
    Lens,
    centered_pinhole,
    pinhole,
)
from splatpilot.training.captures.capture_config import CaptureConfig

_SCANNET_COLOR = Path("intrinsic", "intrinsic_color.txt")
_SCANNET_DEPTH = Path("intrinsic", "intrinsic_depth.txt")

# fx, fy, cx, cy [px] of 7-Scenes at 640x480. Those of depth are published; the color camera and its
# position in the depth camera [m] were measured on redkitchen by agreement of colors.
_SEVEN_SCENES_DEPTH = (585.0, 585.0, 320.0, 240.0)
_SEVEN_SCENES_COLOR = (523.0, 523.0, 320.0, 240.0)
_P_DC = (0.024, 0.005, 0.0)


def recognizes_scannet(path: Path) -> bool:
    """Tells whether a folder looks like an exported scan of ScanNet."""
    return (path / _SCANNET_COLOR).is_file() and (path / "pose").is_dir()


def read_scannet(path: Path, config: CaptureConfig) -> Capture:
    """Opens a folder as ScanNet's reader exports it (Dai et al., "ScanNet", CVPR 2017).

    `color/0.jpg`, `depth/0.png` in millimeters, `pose/0.txt` 4x4, camera to world with z up, -inf
    where tracking was lost, `intrinsic/intrinsic_color.txt` and `intrinsic_depth.txt` 4x4, counted
    from the first pixel's center. The axes of both cameras are the same.
    """
    colors = frames.numbered_files(path / "color", r"(\d+)\.(?:jpg|jpeg|png)")
    lost = set()
    for number in colors:
        with suppress(OSError, ValueError):
            if not np.isfinite(frames.read_matrix(path / "pose" / f"{number}.txt")).all():
                lost.add(number)
    K_C = K_D = _intrinsics(path / _SCANNET_COLOR)
    if config.depth_intrinsics:
        K_D = pinhole(*config.depth_intrinsics)
    elif (path / _SCANNET_DEPTH).is_file():
        K_D = _intrinsics(path / _SCANNET_DEPTH)

    def frame(number: int, color: Path) -> frames.FrameFiles:
        pose, depth = path / "pose" / f"{number}.txt", path / "depth" / f"{number}.png"
        return frames.FrameFiles(
            color,
            lambda: frames.pose_from_matrix(frames.read_matrix(pose), str(pose)),
            depth if depth.is_file() else None,
        )

    def depth_camera(width: int, height: int) -> DepthCamera:
        return DepthCamera(Lens(K_D, width, height).K, width, height, RigidTransform())

    return frames.open_frames(
        path,
        "ScanNet folder",
        [frame(number, color) for number, color in colors.items() if number not in lost],
        axes=OPTICAL_AXES,
        config=config,
        lens=lambda width, height: Lens(K_C, width, height, source=str(_SCANNET_COLOR)),
        depth_camera=depth_camera,
        dropped=[f"{path / 'pose'}: tracking was lost in {len(lost)} frames"] if lost else (),
    )


def _intrinsics(file: Path) -> NDArray[np.float64]:
    K = frames.read_matrix(file)
    return centered_pinhole(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def read_seven_scenes(path: Path, config: CaptureConfig) -> Capture:
    """Opens a folder as 7-Scenes (Shotton et al., CVPR 2013): `frame-%06d.color.png`,
    `.depth.png` in millimeters with 0 and 65535 invalid, `.pose.txt` 4x4, depth camera to world.

    `config.intrinsics` and `depth_intrinsics`, if equal and with `p_DC` zero, describe depth that
    is registered to color.
    """
    colors = frames.numbered_files(path, r"frame-(\d+)\.color\.(?:jpg|jpeg|png)")
    X_DC = RigidTransform(np.array(config.p_DC or _P_DC))

    def frame(color: Path) -> frames.FrameFiles:
        stem = color.name.partition(".")[0]
        pose = path / f"{stem}.pose.txt"
        return frames.FrameFiles(
            color,
            lambda: frames.pose_from_matrix(frames.read_matrix(pose), str(pose)) @ X_DC,
            path / f"{stem}.depth.png",
        )

    def lens(width: int, height: int) -> Lens:
        source = "a measurement on redkitchen; set capture.intrinsics for another camera"
        return Lens(pinhole(*_SEVEN_SCENES_COLOR), 640, 480, source=source).scale_to(width, height)

    def depth_camera(width: int, height: int) -> DepthCamera:
        if config.depth_intrinsics:
            K = pinhole(*config.depth_intrinsics)
        else:
            K = Lens(pinhole(*_SEVEN_SCENES_DEPTH), 640, 480).scale_to(width, height).K
        return DepthCamera(K, width, height, X_DC.inverse())

    return frames.open_frames(
        path,
        "7-Scenes folder",
        [frame(color) for color in colors.values()],
        axes=OPTICAL_AXES,
        config=config,
        lens=lens,
        depth_camera=depth_camera,
        up="cameras",
    )
