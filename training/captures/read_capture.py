"""Opens a capture of any known kind."""

from pathlib import Path

from flysplat.training.captures.capture import Capture
from flysplat.training.captures.tartanair import is_tartanair_v1, read_tartanair_v1


def read_capture(path: str | Path) -> Capture:
    """Opens the capture in a folder, whose kind is told from what lies in it.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if the folder is no capture of a known kind, or a damaged one.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder; a capture is a folder")
    if is_tartanair_v1(path):
        return read_tartanair_v1(path)
    raise ValueError(
        f"{path}: no capture of a known kind; known is TartanAir V1 (image_left/, depth_left/, "
        "pose_left.txt)"
    )
