"""Capture formats by name."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from splatpilot.diagrams.worlds.scene_folder import SceneMetadata
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import errors_about, require
from splatpilot.training.captures import (
    colmap,
    nerfstudio,
    photographs,
    ros,
    scans,
    tartanair,
    tum,
)
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CONFIG_FILE, CaptureConfig, complete_config
from splatpilot.training.captures.refine_poses import refined_capture
from splatpilot.training.captures.up_and_scale import move_origin


@dataclass(frozen=True)
class CaptureFormat:
    """Recognizes and reads captures of one format."""

    recognizes: Callable[[Path], object]  # tells whether a folder or file looks like one
    read: Callable[[Path, CaptureConfig], Capture]
    """Opens a capture; raises OSError or ValueError that names the damaged file."""
    description: str = ""
    """Its name in messages, with the files that it is recognized by; empty for its name."""


CAPTURES = Registry("capture format", "splatpilot.captures", CaptureFormat)
"""Capture formats by the names that `CaptureConfig.kind` takes."""


def register_capture(
    name: str,
    recognizes: Callable[[Path], object],
    read: Callable[[Path, CaptureConfig], Capture],
    *,
    description: str = "",
) -> CaptureFormat:
    """Registers a `CaptureFormat`, the value `name` of `capture.kind`, and returns it."""
    added = CaptureFormat(recognizes, read, description)
    CAPTURES.add(name, added)
    return added


# The first format that recognizes a path reads it; any folder of images passes for photographs.
_BUILT_IN = {
    name: register_capture(name, recognizes, read, description=description)
    for name, recognizes, read, description in (
        ("tartanair_v1", partial(tartanair.recognizes, version="V1"),
         partial(tartanair.read, version="V1"),
         "TartanAir V1 (image_left/, depth_left/, pose_left.txt)"),
        ("tartanair_v2", partial(tartanair.recognizes, version="V2"),
         partial(tartanair.read, version="V2"),
         "TartanAir V2 (image_lcam_front/, depth_lcam_front/, pose_lcam_front.txt)"),
        ("nerfstudio", nerfstudio.recognizes, nerfstudio.read, "nerfstudio (transforms.json)"),
        ("tum", tum.recognizes, tum.read, "TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt)"),
        ("seven_scenes", lambda path: any(path.glob("frame-*.color.*")), scans.read_seven_scenes,
         "7-Scenes (frame-000000.color.png, .depth.png, .pose.txt)"),
        ("scannet", scans.recognizes_scannet, scans.read_scannet,
         "ScanNet (color/, depth/, pose/, intrinsic/)"),
        ("polycam", lambda path: any(path.glob("keyframes/*cameras")), scans.read_polycam,
         "Polycam's raw data (keyframes/)"),
        ("record3d", scans.recognizes_record3d, scans.read_record3d,
         "Record3D (metadata.json, rgb/, depth/)"),
        ("colmap", colmap.model_folder, colmap.read_model, "COLMAP (images/, sparse/0/)"),
        ("photographs", photographs.image_files, photographs.read_photographs, "photographs alone"),
        ("rosbag", ros.recognizes, ros.read, "a ROS bag"),
        ("video", photographs.is_video, photographs.read_video, "a video (.mp4, .mov, ...)"),
    )
}  # fmt: skip


def read_capture(path: str | Path, config: CaptureConfig | None = None) -> Capture:
    """Opens a capture of any format, which is recognized by its files, those of other packages
    first. `capture.yaml` in the folder completes `config`."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"No such file or folder: {path}")
    given = config or CaptureConfig()
    if given.cache:  # The same from any working directory.
        given = replace(given, cache=str(Path(given.cache).absolute()))
    config = complete_config(path, given)
    if config.kind != given.kind:
        _require_imported(config.kind, path / CONFIG_FILE)
    capture = (CAPTURES.find(config.kind) if config.kind else _recognize(path)).read(path, config)
    if not isinstance(capture, Capture):
        raise ValueError(
            f"{path}: the reader of its format must return a Capture, got {type(capture).__name__}"
        )
    capture = move_origin(capture, config.origin)
    if config.refine_poses:
        capture = refined_capture(capture, path, config)
    return replace(capture, folder=str(path.absolute()), config=given)


def _require_imported(kind: str, file: Path) -> None:
    """Checks that a format which a file names needs no import."""
    module = kind.partition(":")[0]
    valid = ":" not in kind or module in sys.modules
    remedy = f"put --import {module} in front of the command"
    require(valid, f"{file}: kind", "of an imported module", repr(kind), remedy)


def _recognize(path: Path) -> CaptureFormat:
    for name in sorted(CAPTURES.names(), key=lambda name: name in _BUILT_IN):
        if (found := CAPTURES.find(name)).recognizes(path):
            return found
    known = ", ".join(CAPTURES.find(name).description or name for name in CAPTURES.names())
    raise ValueError(f"{path}: unknown capture format; known are {known}")


def read_scene_capture(scene: Path, metadata: SceneMetadata) -> Capture:
    """Opens the capture that a scene folder was made from, with its settings."""
    file = scene / "scene.yaml"
    if not metadata.capture:
        raise ValueError(
            f"{file}: names no capture to compare the scene with: it came without one, or was "
            "rescaled against the depth of its capture; measure the scene that "
            "`splatpilot reconstruct` wrote"
        )
    with errors_about(f"{file}: capture_settings"):
        config = load_config(CaptureConfig(), overrides=metadata.capture_settings)
    _require_imported(config.kind, file)
    config.origin = metadata.origin
    return read_capture(metadata.capture, config)
