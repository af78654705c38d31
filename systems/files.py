"""Files and folders that appear whole or not at all.

What is being written has a temporary name, `.STEM.HOST.PID.partial.SUFFIX`, beside its place. A
process that is killed leaves it there; `require_writable_folder`, with which every run begins,
removes what dead processes of this host have left.
"""

import ctypes
import errno
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_HOST = re.sub(r"[^\w-]", "-", platform.node()) or "host"
_LEFTOVER = re.compile(rf"\..+\.{re.escape(_HOST)}\.(\d+)\.partial(\..*)?")
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of renameat2(2)


class _UnwritableError(OSError):
    """Says already which file cannot be written."""


@contextmanager
def written_atomically(path: Path, check: Callable[[Path], None] | None = None) -> Iterator[Path]:
    """
    Yields a temporary path beside `path` to write to, which becomes `path` when the block ends.

    An exception in the block removes the temporary file and leaves what stood at `path`. The
    temporary name keeps the suffix, because many writers choose their format by it.

    Args:
        check: raises OSError of a file that its writer left broken without a word; called with the
            temporary file before it is renamed.

    Raises:
        OSError: if it cannot be written; the message names `path`.
    """
    partial = _temporary(path, path.stem, path.suffix)
    try:
        with _naming(path, partial):
            yield partial
            _flush(partial)
            if check is not None:
                check(partial)
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def folder_written_atomically(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """
    Yields a temporary folder beside `path` to write into, which becomes `path` when the block ends.

    An exception in the block removes the temporary folder.

    Args:
        replace: whether it takes the place of a folder that is at `path`. Otherwise what another
            process put there meanwhile stays.

    Raises:
        OSError: if it cannot be written; the message names `path`.
    """
    partial = _temporary(path, path.name)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with _naming(path, partial):
            partial.mkdir(parents=True)
            yield partial
            for file in partial.rglob("*"):
                _flush(file)
            if replace and path.is_dir():
                _exchange(partial, path)
            else:
                _rename_unless_there(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Removes what processes of this host that have ended were writing into a folder."""
    for path in folder.iterdir():
        match = _LEFTOVER.fullmatch(path.name)
        if match is None or _runs(int(match[1])):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def require_existing(path: Path, what: str) -> None:
    """
    Raises:
        FileNotFoundError: if nothing is there; the message says that `what` is expected.
    """
    if not path.exists():
        raise FileNotFoundError(f"No such file or folder: {path}; expected {what}")


def require_unused(path: Path, overwrite: bool) -> None:
    """
    Raises:
        FileExistsError: if there is a file, or a folder that holds anything, and that is not to be
            overwritten.
    """
    if not path.is_dir():
        used = path.exists()
    else:
        used = any(_LEFTOVER.fullmatch(file.name) is None for file in path.iterdir())
    if used and not overwrite:
        raise FileExistsError(
            f"{path} is there already; name another, or replace it with --overwrite"
        )


def require_writable_folder(path: Path) -> None:
    """
    Makes the folder `path` if need be, and removes what dead processes have left in it.

    Raises:
        OSError: if it cannot be made or written to; the message says which and what to do.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = _temporary(path / "probe", "probe")
        probe.touch()
        probe.unlink()
        remove_leftovers(path)
    except OSError as error:
        raise OSError(
            f"cannot write to the output folder {path}: {error.strerror}; choose another with --out"
        ) from None


def _temporary(path: Path, stem: str, suffix: str = "") -> Path:
    return path.with_name(f".{stem}.{_HOST}.{os.getpid()}.partial{suffix}")


@contextmanager
def _naming(path: Path, partial: Path) -> Iterator[None]:
    """Says of which file it is that the disk is full; libraries do not."""
    try:
        yield
    except _UnwritableError:
        raise
    except OSError as error:
        if error.filename is not None and not str(error.filename).startswith(str(partial)):
            raise  # It is about another file.
        remedy = "make room" if error.errno in (None, *_NO_ROOM) else "is the folder writable?"
        reason = error.strerror or str(error)
        raise _UnwritableError(f"{path}: cannot be written ({reason}); {remedy}") from error


def _flush(path: Path) -> None:
    """Some file systems say only now that there is no room."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _rename_unless_there(folder: Path, path: Path) -> None:
    try:
        folder.rename(path)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise


def _exchange(one: Path, other: Path) -> None:
    """Exchanges two folders in one step, where the system can; elsewhere a kill between two steps
    leaves `other` under a temporary name."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    names = os.fsencode(one), os.fsencode(other)
    if rename is not None and not rename(
        _AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE
    ):
        return
    between = one.with_name(f"{one.name}.old")
    other.rename(between)
    one.rename(other)
    between.rename(one)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
