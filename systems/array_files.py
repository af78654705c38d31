"""Reading numpy's files, `.npy` and `.npz`, of which nothing is believed.

A header is compared with the size of its file before an array is made, and no file runs code.
"""

import math
import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from splatpilot.systems.read_limit import require_readable_size

_MAX_HEADER = 10_000  # [characters]


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """
    The arrays of an `.npz` file by name.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none, damaged, holds Python objects, or would take more memory than
            `read_limit` allows; the message names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            require_readable_size(path, sum(entry.file_size for entry in entries))
            return {
                entry.filename.removesuffix(".npy"): _read_entry(archive, entry)
                for entry in entries
            }
    except Exception as error:  # zipfile, zlib and numpy raise anything of damaged files
        if str(path) in str(error):  # it is too large
            raise
        raise ValueError(f"{path}: not a readable numpy archive ({reason_of(error)})") from None


def read_array(path: Path) -> np.ndarray:
    """
    The array in an `.npy` file.

    Raises:
        OSError, ValueError: see `array_shape`.
    """
    shape, dtype = array_layout(path)
    require_readable_size(path, math.prod(shape) * dtype.itemsize)
    return np.load(path, allow_pickle=False)


def array_layout(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    """
    Shape and type of the array in an `.npy` file.

    Raises:
        OSError: if it cannot be opened.
        ValueError: if it is none, cut short or holds Python objects; the message names it.
    """
    with path.open("rb") as file:
        try:
            return _layout(file, path.stat().st_size)
        except Exception as error:
            raise ValueError(
                f"{path}: not a readable array ({reason_of(error)}); copy it again"
            ) from None


def reason_of(error: object) -> str:
    """What an exception of a library says, in one line that does not repeat whole files."""
    words = str(error).split()
    short = (word if len(word) <= 80 else f"{word[:20]}...{word[-40:]}" for word in words)
    return " ".join(short)[:300] or type(error).__name__


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as file:
        _layout(file, entry.file_size)
    with archive.open(entry) as file:
        return npy.read_array(file, allow_pickle=False, max_header_size=_MAX_HEADER)


def _layout(file: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of the array that begins here, which has all of these bytes."""
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file, max_header_size=_MAX_HEADER)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    if not dtype.itemsize or any(length < 0 for length in shape):
        raise ValueError(f"its header claims {dtype} of shape {shape}")
    claimed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if claimed != there:
        raise ValueError(f"its header claims {dtype} of shape {shape}, {claimed} bytes of {there}")
    return shape, dtype
