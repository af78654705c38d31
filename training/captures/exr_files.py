"""Depth in OpenEXR files, which OpenCV's builds do not read."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.extras import import_extra


def exr_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] without reading the pixels.

    Raises:
        ValueError: if it is no EXR file.
        ModuleNotFoundError: if the extra `exr` is not installed.
    """
    (left, top), (right, bottom) = _open(file, header_only=True).header()["dataWindow"]
    return int(right - left + 1), int(bottom - top + 1)


def read_exr(file: Path) -> NDArray[np.float32]:
    """Returns the pixels (H, W) of a file of one channel, or of its first if it has several.

    Raises:
        ValueError: if it is no EXR file.
        ModuleNotFoundError: if the extra `exr` is not installed.
    """
    channels = _open(file, separate_channels=True).channels()
    return np.asarray(next(iter(channels.values())).pixels, dtype=np.float32)


def _open(file: Path, **options: bool) -> Any:
    OpenEXR: Any = import_extra("OpenEXR", "exr")
    try:
        return OpenEXR.File(str(file), **options)
    except Exception as error:  # OpenEXR raises anything of damaged files
        raise ValueError(f"{file}: not a readable EXR file ({error}); copy it again") from None
