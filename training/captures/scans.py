"""RGB-D scans: ScanNet, 7-Scenes, Polycam's raw data and exports of Record3D."""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.common.readers import read_text, readable
from splatpilot.systems.common.validation import require
from splatpilot.training.captures import frames
from splatpilot.training.captures.capture import (
    OPENGL_AXES,
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
    """Opens a folder as ScanNet's reader exports it (Dai et al., "ScanNet", CVPR 2017): depth in
    millimeters; poses 4x4, camera to world with z up, -inf where tracking was lost; intrinsics 4x4,
    counted from the first pixel's center. The axes of both cameras are the same."""
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
        depth = frames.first_file(path / "depth" / f"{number}.png")
        return frames.FrameFiles(color, lambda: _pose(path / "pose" / f"{number}.txt"), depth)

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


def _pose(file: Path) -> RigidTransform:
    return frames.pose_from_matrix(frames.read_matrix(file), str(file))


def _intrinsics(file: Path) -> NDArray[np.float64]:
    K = frames.read_matrix(file)
    return centered_pinhole(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def read_seven_scenes(path: Path, config: CaptureConfig) -> Capture:
    """Opens a folder as 7-Scenes (Shotton et al., CVPR 2013): depth in millimeters with 0 and 65535
    invalid; poses 4x4, depth camera to world. Equal `config.intrinsics` and `depth_intrinsics`,
    with `p_DC` zero, describe registered depth."""
    colors = frames.numbered_files(path, r"frame-(\d+)\.color\.(?:jpg|jpeg|png)")
    X_DC = RigidTransform(np.array(config.p_DC or _P_DC))

    def frame(color: Path) -> frames.FrameFiles:
        stem = color.name.partition(".")[0]
        depth = path / f"{stem}.depth.png"
        return frames.FrameFiles(color, lambda: _pose(path / f"{stem}.pose.txt") @ X_DC, depth)

    def lens(width: int, height: int) -> Lens:
        source = "a measurement on redkitchen; set capture.intrinsics for another camera"
        return Lens(pinhole(*_SEVEN_SCENES_COLOR), 640, 480, source=source).scale_to(width, height)

    def depth_camera(width: int, height: int) -> DepthCamera:
        K = Lens(pinhole(*_SEVEN_SCENES_DEPTH), 640, 480).scale_to(width, height).K
        K = pinhole(*config.depth_intrinsics) if config.depth_intrinsics else K
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


_METADATA = "metadata.json"


def read_polycam(path: Path, config: CaptureConfig) -> Capture:
    """Opens the raw data of a LiDAR capture of Polycam, as it documents them: `t_00` to `t_23` of a
    keyframe are its pose, from camera axes of OpenGL to a world with y up; depth is in millimeters,
    in fewer pixels than the image; `corrected_` folders hold optimized poses and undistorted
    images."""
    folder = path / "keyframes"
    prefix = "corrected_" if (folder / "corrected_cameras").is_dir() else ""

    def frame(camera: Path) -> frames.FrameFiles:
        def X_FB() -> RigidTransform:
            if isinstance(read, ValueError):
                raise read
            return frames.pose_from_matrix(read[1], str(camera))

        image = folder / f"{prefix}images" / f"{camera.stem}.jpg"
        try:
            read = _read_keyframe(camera, image, config.intrinsics)
        except ValueError as error:
            read = error
        lens = None if isinstance(read, ValueError) else read[0]
        depth, confidence = (
            frames.first_file(folder / name / f"{camera.stem}.png")
            for name in ("depth", "confidence")
        )
        return frames.FrameFiles(image, X_FB, depth, lens, confidence=confidence)

    pattern = r"(\d+)\.json"
    cameras = frames.numbered_files(folder / f"{prefix}cameras", pattern)
    dropped = []
    raw_folder = folder / "cameras"
    if prefix and raw_folder.is_dir() and any(raw_folder.iterdir()):
        raw = frames.numbered_files(raw_folder, pattern)
        if alone := len(raw.keys() - cameras.keys()):
            dropped = [f"{folder}: {alone} of {len(raw)} keyframes have no corrected camera"]
    return frames.open_frames(
        path,
        "Polycam capture",
        [frame(camera) for camera in cameras.values()],
        axes=OPENGL_AXES,
        config=config,
        stretch_depth=True,
        up="y",
        dropped=dropped,
    )


def _read_keyframe(
    camera: Path, image: Path, intrinsics: Sequence[float]
) -> tuple[Lens, NDArray[np.float64]]:
    """Returns the camera and the pose (3, 4) of a keyframe."""
    text = read_text(camera)
    with readable(camera, "camera of a keyframe"):
        values = json.loads(text)
        focal = intrinsics or [float(values[name]) for name in ("fx", "fy", "cx", "cy")]
        source = "capture.intrinsics" if intrinsics else f"{camera.parent.name}/"
        if "width" not in values:  # as in newer corrected cameras
            values["width"], values["height"] = frames.image_header(image)[0]
        lens = Lens(pinhole(*focal), int(values["width"]), int(values["height"]), source=source)
        matrix = [float(values[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
    return lens, np.array(matrix).reshape(3, 4)


def recognizes_record3d(path: Path) -> bool:
    """Tells whether a path looks like an export of Record3D."""
    return path.suffix == ".r3d" or ((path / _METADATA).is_file() and (path / "rgb").is_dir())


def read_record3d(path: Path, config: CaptureConfig) -> Capture:
    """Opens an export "EXR + RGB" of Record3D, as its author documents it: `poses` are rows qx qy
    qz qw tx ty tz, from camera axes of OpenGL to the first camera's, so that up is unknown; `K` is
    stored column by column for images of `w` x `h`; `perFrameIntrinsicCoeffs`, in newer exports,
    are rows fx fy cx cy; depth is in meters, in fewer pixels than the image."""
    if path.suffix == ".r3d":
        raise ValueError(
            f"{path}: Record3D's own format, whose depth is compressed; export the recording as "
            '"EXR + RGB" and name that folder'
        )
    file = path / _METADATA
    text = read_text(file)
    with readable(file, "file of Record3D's metadata"):
        content = json.loads(text)
        poses = np.array(content["poses"], dtype=np.float64)
        require(poses.ndim == 2 and poses.shape[1] == 7, "poses", "of shape (N, 7)", poses.shape)
        K = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
        intrinsics = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(poses), 1))
        own = np.array(content.get("perFrameIntrinsicCoeffs") or [], dtype=np.float64)
        intrinsics = own if own.shape == intrinsics.shape else intrinsics  # fx fy cx cy
        size = int(content["w"]), int(content["h"])
    images = frames.numbered_files(path / "rgb", r"(\d+)\.(?:jpg|jpeg|png)")
    if max(images) >= len(poses):
        raise ValueError(
            f"{file}: {len(poses)} poses, but {images[max(images)].name} is frame {max(images)}; "
            "the folder and its metadata belong to different exports"
        )
    lenses: dict[bytes, Lens] = {}  # Equal cameras share one, and one resampling.

    def frame(i: int, image: Path) -> frames.FrameFiles:
        values = np.array(config.intrinsics) if config.intrinsics else intrinsics[i]
        source = "capture.intrinsics" if config.intrinsics else _METADATA
        lens = Lens(pinhole(*values), *size, source=source)
        return frames.FrameFiles(
            image,
            lambda: frames.pose_from_quaternion(np.roll(poses[i], 3), f"{file}, frame {i}"),
            frames.first_file(path / "depth" / f"{i}.exr"),
            lenses.setdefault(values.tobytes(), lens),
        )

    return frames.open_frames(
        path,
        "Record3D export",
        [frame(i, image) for i, image in images.items()],
        axes=OPENGL_AXES,
        config=config,
        depth_unit=1.0,
        stretch_depth=True,
        up="cameras",
    )
