"""Files and folders that appear whole or not at all."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_atomically(path: Path) -> Iterator[Path]:
    """
    Yields a temporary path beside `path` to write to, which becomes `path` when the block ends.

    An exception in the block removes the temporary file and leaves what stood at `path`. The
    temporary name keeps the suffix, because many writers choose their format by it.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def require_existing(path: Path, what: str) -> None:
    """
    Raises:
        FileNotFoundError: if nothing is there; the message says that `what` is needed.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file or folder; {what} is needed")


def require_unused(path: Path, overwrite: bool) -> None:
    """
    Raises:
        FileExistsError: if there is a file, or a folder that holds anything, and that is not to be
            overwritten.
    """
    used = any(path.iterdir()) if path.is_dir() else path.exists()
    if used and not overwrite:
        raise FileExistsError(
            f"{path} is there already; name another --out, or replace it with --overwrite"
        )


def require_writable_folder(path: Path) -> None:
    """
    Makes the folder `path` if need be.

    Raises:
        OSError: if it cannot be made or written to; the message says which and what to do.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".{os.getpid()}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OSError(
            f"cannot write to the output folder {path}: {error.strerror}; choose another with --out"
        ) from None


@contextmanager
def folder_written_atomically(path: Path) -> Iterator[Path]:
    """
    Yields a temporary folder beside `path` to write into, which becomes `path` when the block ends.

    An exception in the block removes the temporary folder. What another process put at `path`
    meanwhile stays.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        try:
            partial.rename(path)
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
