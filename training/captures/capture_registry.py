"""Opens a capture of any known kind."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from splatpilot.diagrams.worlds.scene_folder import SceneMetadata
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.registry import Registry
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig, complete_config
from splatpilot.training.captures.colmap import (
    is_video,
    model_folder,
    photographs_in,
    read_colmap,
    read_photographs,
    read_video,
)
from splatpilot.training.captures.nerfstudio import is_nerfstudio, read_nerfstudio
from splatpilot.training.captures.phone import is_polycam, is_record3d, read_polycam, read_record3d
from splatpilot.training.captures.refine_poses import refined_capture
from splatpilot.training.captures.ros import is_rosbag, read_rosbag
from splatpilot.training.captures.scans import (
    is_scannet,
    is_seven_scenes,
    read_scannet,
    read_seven_scenes,
)
from splatpilot.training.captures.tartanair import (
    is_tartanair_v1,
    is_tartanair_v2,
    read_tartanair_v1,
    read_tartanair_v2,
)
from splatpilot.training.captures.tum import is_tum, read_tum
from splatpilot.training.captures.up_and_scale import move_origin


@dataclass(frozen=True)
class CaptureKind:
    """How captures of one kind are told from others, and opened."""

    recognizes: Callable[[Path], bool]
    """Tells whether a path looks like one, whole or not: a folder, or a file."""
    read: Callable[[Path, CaptureConfig], Capture]
    """Opens the capture in a folder. Raises FileNotFoundError, OSError or ValueError that names the
    file where it is damaged."""
    description: str = ""
    """What it is called in messages, with the files by which it is known; empty for its name."""


CAPTURES = Registry("kind of capture", "splatpilot.captures", CaptureKind)
"""All kinds of captures by the names that `CaptureConfig.kind` takes."""


def register_capture(
    name: str,
    recognizes: Callable[[Path], bool],
    read: Callable[[Path, CaptureConfig], Capture],
    *,
    description: str = "",
) -> CaptureKind:
    """Makes a kind of capture known, so that `read_capture` opens it, and returns the kind.

    Args:
        name: what `capture.kind` calls it.
        recognizes, read, description: see `CaptureKind`.

    Raises:
        ValueError: if another kind has the name.
    """
    kind = CaptureKind(recognizes, read, description)
    CAPTURES.add(name, kind)
    return kind


# In this order: what the first recognises is not asked of the others.
register_capture(
    "tartanair_v1",
    is_tartanair_v1,
    read_tartanair_v1,
    description="TartanAir V1 (image_left/, depth_left/, pose_left.txt)",
)
register_capture(
    "tartanair_v2",
    is_tartanair_v2,
    read_tartanair_v2,
    description="TartanAir V2 (image_lcam_front/, depth_lcam_front/, pose_lcam_front.txt)",
)
register_capture(
    "nerfstudio", is_nerfstudio, read_nerfstudio, description="nerfstudio (transforms.json)"
)
register_capture(
    "tum", is_tum, read_tum, description="TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt)"
)
register_capture(
    "seven_scenes",
    is_seven_scenes,
    read_seven_scenes,
    description="7-Scenes (frame-000000.color.png, .depth.png, .pose.txt)",
)
register_capture(
    "scannet",
    is_scannet,
    read_scannet,
    description="ScanNet (color/, depth/, pose/, intrinsic/)",
)
register_capture("polycam", is_polycam, read_polycam, description="Polycam's raw data (keyframes/)")
register_capture(
    "record3d", is_record3d, read_record3d, description="Record3D (metadata.json, rgb/, depth/)"
)
register_capture(
    "colmap",
    lambda path: model_folder(path) is not None,
    read_colmap,
    description="COLMAP (images/, sparse/0/)",
)
register_capture(
    "photographs",
    lambda path: len(photographs_in(path)) > 0,
    read_photographs,
    description="photographs alone",
)

register_capture("rosbag", is_rosbag, read_rosbag, description="a ROS bag")
register_capture("video", is_video, read_video, description="a video (.mp4, .mov, ...)")

_OURS = CAPTURES.registered()


def read_capture(path: str | Path, config: CaptureConfig | None = None) -> Capture:
    """Opens the capture in a folder, or a video, whose kind is told from what lies in it.

    Kinds of other packages are asked first: any folder of images passes for photographs.

    Args:
        path: the folder or the video.
        config: what the files leave open; a file `capture.yaml` in the folder gives what it does
            not.

    Raises:
        FileNotFoundError: if there is nothing there.
        ValueError: if it is no capture of a known kind, or a damaged one, or `config` makes
            no sense, or its poses are to be refined and cannot be.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such folder or video")
    said = config or CaptureConfig()
    if said.cache:  # found again from wherever the capture is opened with these settings
        said = replace(said, cache=str(Path(said.cache).absolute()))
    config = complete_config(path, said)
    kind = CAPTURES.find(config.kind) if config.kind else _recognize(path)
    capture = kind.read(path, config)
    if not isinstance(capture, Capture):
        raise ValueError(
            f"{path}: what reads its kind gave {type(capture).__name__}; it must return a Capture"
        )
    capture = move_origin(capture, config.origin)
    if config.refine_poses:
        capture = refined_capture(capture, path, config)
    return replace(capture, folder=str(path.absolute()), config=said)


def _recognize(path: Path) -> CaptureKind:
    kinds = {
        name: CAPTURES.find(name) for name in sorted(CAPTURES.names(), key=lambda n: n in _OURS)
    }
    for kind in kinds.values():
        if kind.recognizes(path):
            return kind
    known = ", ".join(kinds[name].description or name for name in CAPTURES.names())
    raise ValueError(f"{path}: no capture of a known kind; known are {known}")


def read_capture_of(scene: Path, metadata: SceneMetadata) -> Capture:
    """Opens the capture that a scene folder was made from, with the settings it was made with.

    Raises:
        FileNotFoundError, ValueError, OSError: if `metadata` names none, or it cannot be opened.
    """
    file = scene / "scene.yaml"
    if not metadata.capture:
        raise ValueError(
            f"{file}: names no capture to compare the scene with: it came without one, or has "
            "another size than the depth that its capture measured; measure the scene that "
            "`splatpilot reconstruct` wrote"
        )
    try:
        config = load_config(CaptureConfig(), overrides=metadata.capture_settings)
    except ValueError as error:
        raise ValueError(f"{file}: capture_settings: {error}") from None
    config.origin = metadata.origin
    return read_capture(metadata.capture, config)
