"""Reading of files from outside: sizes are limited, no file runs code, errors have one form."""

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml
from plyfile import PlyData

LIMIT = "SPLATPILOT_READ_LIMIT"
"""Environment variable with the largest size [GB] that a file may have in memory."""

MAX_TEXT = 64_000_000
"""[bytes] of a text file, such as a configuration or a list of frames."""

_DEFAULT_LIMIT = 8e9  # [bytes]


def require_readable_size(path: Path, size: float) -> None:
    """Checks that what `path` becomes in memory, `size` [bytes], is within the limit.

    The limit is `SPLATPILOT_READ_LIMIT` or, if that is not set, 8 GB or half of the memory.
    """
    text = os.environ.get(LIMIT)
    limit = min(_DEFAULT_LIMIT, 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    if text is not None:
        try:
            limit = 1e9 * float(text)
        except ValueError:
            limit = 0.0
        if not limit > 0.0:
            raise ValueError(f"{LIMIT} must be a positive number of GB, got {text!r}")
    if not size <= limit:
        raise ValueError(
            f"{path} must take at most {limit / 1e9:.3g} GB of memory, got {size / 1e9:.3g} GB; "
            f"to read it nevertheless, set {LIMIT} to more"
        )


def require_file(path: Path) -> None:
    """Raises FileNotFoundError unless there is a file."""
    if not path.is_file():
        raise FileNotFoundError(f"No such file: {path}")


def read_text(path: Path, errors: str = "strict") -> str:
    """Reads a text file in UTF-8 of at most `MAX_TEXT` bytes; for `errors` see `open`."""
    require_file(path)
    if (size := path.stat().st_size) > MAX_TEXT:
        limit, remedy = f"at most {MAX_TEXT / 1e6:g} MB", "choose another file"
        raise ValueError(f"{path} must have {limit}, got {size / 1e6:.3g} MB; {remedy}")
    try:
        return path.read_text(encoding="utf-8-sig", errors=errors)
    except UnicodeDecodeError as error:
        found = f"{error.object[error.start]:#04x} at byte {error.start}"
        raise ValueError(f"{path} must be a text in UTF-8, got {found}") from None


@contextmanager
def yaml_errors(source: str) -> Iterator[None]:
    """Converts errors of a YAML reader to "`source` is not YAML: ..." in one line."""
    try:
        yield
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        if "expected a mapping node" in (error.problem or ""):
            raise ValueError(f"{source}: {line}a tag must have fields, as !Name {{}}") from None
        raise ValueError(f"{source} is not YAML: {line}{error_summary(error.problem)}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"{source} is not YAML: {error_summary(error)}") from None
    except RecursionError:
        raise ValueError(f"{source} is not YAML: its fields are nested too deeply") from None


def yaml_collections(root: yaml.Node | None) -> Iterator[tuple[yaml.CollectionNode, bool]]:
    """Yields the mappings and lists of a tree of YAML, and whether each stands there again, by an
    alias."""
    parts, seen = [root], set[int]()
    while parts:
        node = parts.pop()
        if not isinstance(node, yaml.CollectionNode):
            continue
        again = id(node) in seen
        yield node, again
        if not again:
            seen.add(id(node))
            inner = node.value
            parts += [v for _, v in inner] if isinstance(node, yaml.MappingNode) else inner


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of an `.npz` file by name; it may hold no Python objects."""
    require_file(path)
    with readable(path, "numpy archive"), zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    require_readable_size(path, size)
    with readable(path, "numpy archive"), np.load(path, allow_pickle=False) as arrays:
        read = dict(arrays)
        if other := [name for name, array in read.items() if not isinstance(array, np.ndarray)]:
            raise ValueError(f"{other[0]} is not an array")
    return read


def read_array(path: Path) -> np.ndarray:
    """Reads the array of an `.npy` file."""
    array = _mapped(path)
    require_readable_size(path, array.nbytes)
    return np.array(array)


def array_layout(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    """Returns shape and type of the array of an `.npy` file."""
    array = _mapped(path)
    return array.shape, array.dtype


def _mapped(path: Path) -> np.ndarray:
    require_file(path)
    with readable(path, "array"):
        return np.lib.format.open_memmap(path, mode="r")


def read_ply_file(path: Path) -> PlyData:
    """Reads the elements of a PLY file."""
    require_file(path)
    require_readable_size(path, path.stat().st_size)
    with readable(path, "PLY file"):
        return PlyData.read(str(path))


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """Converts any error of a reader to "`path`: not a readable `what`"."""
    try:
        yield
    except Exception as error:  # zipfile, numpy and plyfile raise any type for damaged files.
        raise ValueError(
            f"{path}: not a readable {what} ({error_summary(error)}); it is truncated or damaged, "
            "copy it again"
        ) from None


def error_summary(error: object) -> str:
    """Returns the message of an exception in one line of at most 300 characters."""
    words = str(error).split()
    short = (word if len(word) <= 80 else f"{word[:20]}...{word[-40:]}" for word in words)
    return " ".join(short)[:300] or type(error).__name__


LFS_POINTER = b"version https://git-lfs"
"""Start of a file that git-LFS has not downloaded."""

LFS_ERROR = "the pointer of git-LFS to a file, not the file; run `git lfs pull` where it comes from"
