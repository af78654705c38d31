"""Where captures keep what takes long to make of their files."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from splatpilot.systems import environment
from splatpilot.systems.files import remove_leftovers
from splatpilot.training.captures.capture_config import CaptureConfig


def cache_folder(config: CaptureConfig, *parts: str) -> Path:
    """The folder that a capture keeps what is made of it in: what it names, or in the user's."""
    if config.cache:
        return Path(config.cache)
    return environment.cache_folder(*parts)


def cache_key(files: Iterable[Path], *others: object) -> str:
    """A name for what is made of files, by their paths, sizes and times, and of what else decides
    it."""
    key = hashlib.sha256(repr(others).encode())
    for file in files:
        status = file.stat()
        key.update(f"{file.resolve()} {status.st_size} {status.st_mtime_ns}".encode())
    return key.hexdigest()[:16]


def prepare_cache(folder: Path) -> None:
    """Makes a folder to keep things in, and removes what was left half written there.

    Raises:
        OSError: if it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"{folder}: cannot be written ({error.strerror}); set capture.cache to a folder that "
            "can"
        ) from None
    remove_leftovers(folder)
