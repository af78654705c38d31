"""How much of the memory what is read may take: what files claim is held against it, and against
their own size, before anything is made of them."""

import math
import os
import re
import struct
import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy
from plyfile import PlyData, PlyElementParseError

LIMIT = "SPLATPILOT_READ_LIMIT"
"""Names the largest size that a file may have when it has been read [GB]."""

MAX_TEXT = 64_000_000
"""[bytes], of a text that describes something: a configuration or a list of frames."""

_MAX_DEPTH = 50
_NESTED = re.compile(r"[][{}]")
_DASHES = re.compile(r"(?:[-?:]\s+){50}")

_DEFAULT = 8e9  # [bytes]


def read_limit() -> float:
    """The limit [bytes]: what the environment says, or 8 GB, or half of the memory if that is less.

    Raises:
        ValueError: if the environment variable is no positive number.
    """
    text = os.environ.get(LIMIT)
    if text is None:
        return min(_DEFAULT, 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    try:
        limit = 1e9 * float(text)
    except ValueError:
        limit = 0.0
    if not limit > 0.0:
        raise ValueError(f"{LIMIT} is {text!r}; it must be a positive number of GB, as 16")
    return limit


def require_readable_size(path: Path, size: float) -> None:
    """
    Args:
        size: [bytes], of what would be made of the file `path`.

    Raises:
        ValueError: if that is more than `read_limit`.
    """
    limit = read_limit()
    if not size <= limit:
        raise ValueError(
            f"{path} would take {size / 1e9:.3g} GB of memory, of which files may take "
            f"{limit / 1e9:.3g} GB; if it is meant, set {LIMIT} to more"
        )


def require_shallow(text: str, source: str) -> None:
    """
    Raises:
        ValueError: if brackets of `text`, or dashes of its lists, stand in each other so deep that
            readers of YAML take for ever; the message begins with `source`.
    """
    depth = deepest = 0
    for bracket in _NESTED.findall(text):
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0)
        deepest = max(deepest, depth)
    if deepest > _MAX_DEPTH or _DASHES.search(text):
        raise ValueError(f"{source}: fields are nested too deeply; name another file")


def read_text(path: Path, errors: str = "strict") -> str:
    """
    The content of a text file.

    Args:
        errors: what becomes of bytes that are no text, see `open`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text, or larger than `MAX_TEXT`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if (size := path.stat().st_size) > MAX_TEXT:
        raise ValueError(
            f"{path} has {size / 1e6:.3g} MB; a text that describes something has at most "
            f"{MAX_TEXT / 1e6:g} MB: name another file"
        )
    try:
        return path.read_text(encoding="utf-8", errors=errors)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text: byte {error.start} is {error.object[error.start]:#04x}; name "
            "another file"
        ) from None


# Reading numpy's files, `.npy` and `.npz`, of which nothing is believed.
#
# A header is compared with the size of its file before an array is made, and no file runs code.


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


_MAX_PLY_HEADER = 1 << 16  # [bytes]
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
"""[bytes], of a number in binary."""


def read_ply_file(path: Path) -> PlyData:
    """
    The elements of a PLY file, binary of either byte order or ASCII.

    Raises:
        ValueError: if it is none, cut short, damaged, or would take more memory than `read_limit`
            allows; the message names it.
    """
    size = path.stat().st_size
    require_readable_size(path, size)
    with path.open("rb") as file:
        start = file.read(_MAX_PLY_HEADER)
    try:
        least = _least_size(start)
    except (ValueError, LookupError) as error:
        raise ValueError(f"{path}: not a PLY file ({reason_of(error)})") from None
    if least > size:
        raise ValueError(
            f"{path}: the data do not match the header, which claims {least} bytes or more of "
            f"{size}; the file is truncated or damaged, copy it again"
        )
    try:
        return PlyData.read(str(path))
    except PlyElementParseError as error:
        raise ValueError(
            f"{path}: the data do not match the header ({reason_of(error)}); the file is truncated "
            "or damaged, copy it again"
        ) from None
    except Exception as error:  # plyfile raises anything of damaged files
        raise ValueError(f"{path}: not a PLY file ({reason_of(error)})") from None


def _least_size(start: bytes) -> int:
    """The least bytes that a file has whose header begins so."""
    header, end, _ = start.partition(b"end_header")
    if not start.startswith(b"ply") or not end:
        raise ValueError("no header from 'ply' to 'end_header' begins it")
    ascii_text = False
    elements: list[list[int]] = []  # rows, and the least bytes of each
    for line in header.decode("ascii").splitlines():
        match line.split():
            case ["format", kind, _]:
                ascii_text = kind == "ascii"
            case ["element", _, number]:
                elements.append([int(number), 0])
            case ["property", "list", kind, _, _] | ["property", kind, _]:
                # In a text a digit and what parts it from the next.
                elements[-1][1] += 2 if ascii_text else _SIZES[kind]
    for rows, row in elements:
        if rows < 0 or (rows > 0 and row == 0):
            raise ValueError(f"an element claims {rows} rows of {row} bytes")
    return len(header) + len(end) + sum(rows * row for rows, row in elements)


POINTER = b"version https://git-lfs"
"""How that begins."""

REFUSAL = "the pointer of git-LFS to a file, not the file; run `git lfs pull` where it comes from"


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_AROUND = 12  # [bytes] of a chunk beside its content


def require_whole_chunks(path: Path, content: bytes) -> None:
    """
    Args:
        path: the file, for messages.
        content: of it; what is no PNG passes.

    Raises:
        ValueError: if a chunk is longer than what is left of the file.
    """
    if not content.startswith(_SIGNATURE):
        return
    begin = len(_SIGNATURE)
    while begin + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, begin)
        begin += length + _AROUND
        if begin > len(content):
            raise ValueError(
                f"{path}: a chunk of the PNG claims {length} bytes, more than there are; the file "
                "is damaged, copy it again"
            )
        if kind == b"IEND":
            return
