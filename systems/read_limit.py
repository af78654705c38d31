"""How much of the memory what is read may take: what files claim is held against it, and against
their own size, before anything is made of them."""

import os
import re
from pathlib import Path

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
