"""Opens a capture of any known kind."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig, complete_config
from splatpilot.training.captures.colmap import model_folder, read_colmap
from splatpilot.training.captures.nerfstudio import is_nerfstudio, read_nerfstudio
from splatpilot.training.captures.photographs import photographs_in, read_photographs
from splatpilot.training.captures.seven_scenes import is_seven_scenes, read_seven_scenes
from splatpilot.training.captures.tartanair import (
    is_tartanair_v1,
    is_tartanair_v2,
    read_tartanair_v1,
    read_tartanair_v2,
)
from splatpilot.training.captures.tum import is_tum, read_tum

Reader = Callable[[Path, CaptureConfig], Capture]

# In this order: what the first fits is not asked of the others.
_KINDS: dict[str, tuple[Callable[[Path], bool], Reader, str]] = {
    "tartanair_v1": (
        is_tartanair_v1,
        read_tartanair_v1,
        "TartanAir V1 (image_left/, depth_left/, pose_left.txt)",
    ),
    "tartanair_v2": (
        is_tartanair_v2,
        read_tartanair_v2,
        "TartanAir V2 (image_lcam_front/, depth_lcam_front/, pose_lcam_front.txt)",
    ),
    "nerfstudio": (is_nerfstudio, read_nerfstudio, "nerfstudio (transforms.json)"),
    "tum": (is_tum, read_tum, "TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt)"),
    "seven_scenes": (
        is_seven_scenes,
        read_seven_scenes,
        "7-Scenes (frame-000000.color.png, .depth.png, .pose.txt)",
    ),
    "colmap": (
        lambda path: model_folder(path) is not None,
        read_colmap,
        "COLMAP (images/, sparse/0/)",
    ),
    "photographs": (
        lambda path: len(photographs_in(path)) > 0,
        read_photographs,
        "photographs alone",
    ),
}

KINDS = tuple(_KINDS)
"""The kinds of captures by the names that `CaptureConfig.kind` takes."""


def read_capture(path: str | Path, config: CaptureConfig | None = None) -> Capture:
    """Opens the capture in a folder, whose kind is told from what lies in it.

    Args:
        path: the folder.
        config: what the files leave open; a file `capture.yaml` in the folder gives what it does
            not.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if the folder is no capture of a known kind, or a damaged one, or `config` makes
            no sense.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder; a capture is a folder")
    said = config or CaptureConfig()
    config = complete_config(path, said)
    if config.kind and config.kind not in _KINDS:
        raise ValueError(f"capture.kind is {config.kind!r}; known are {', '.join(KINDS)}")
    for kind, (fits, read, _) in _KINDS.items():
        if config.kind == kind or (not config.kind and fits(path)):
            return replace(read(path, config), folder=str(path.absolute()), config=said)
    known = ", ".join(description for _, _, description in _KINDS.values())
    raise ValueError(f"{path}: no capture of a known kind; known are {known}")
