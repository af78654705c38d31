"""Files and folders that appear whole or not at all.

What is being written has a temporary name, `.STEM.HOST.PID.partial.SUFFIX`, beside its place. A
process that is killed leaves it there; `require_writable_folder`, with which every run begins,
removes what dead processes of this host have left.
"""

import contextlib
import ctypes
import errno
import fcntl
import functools
import inspect
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatpilot.systems.common.config import dump_config, load_config

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


def claim_folder(file: Path, config: Any, overwrite: bool = False) -> str:
    """
    Makes the folder of `file` one of what `config` describes, which it may be already, and writes
    `config` there.

    Args:
        overwrite: whether the folder may be of something else.

    Returns:
        The configuration as YAML.

    Raises:
        ValueError: if the file holds another configuration, or the folder something else.
        OSError: if it cannot be written.
    """
    require_writable_folder(file.parent)
    text = dump_config(config)
    if overwrite:
        pass
    elif file.exists():
        there = dump_config(load_config(type(config)(), file))
        if there != text:
            own = text.splitlines()
            other = next((line for line in there.splitlines() if line not in own), "").strip()
            raise ValueError(
                f"{file} holds another configuration{f', with {other}' if other else ''}; choose "
                "another --out, or the same configuration to go on there"
            )
    elif there := sorted(p.name for p in file.parent.iterdir() if not p.name.startswith(".")):
        raise ValueError(
            f"{file.parent} holds {there[0]} and no {file.name}; choose another --out, or an empty "
            "folder"
        )
    with written_atomically(file) as partial:
        partial.write_text(text)
    return text


@contextmanager
def held_folder(path: Path) -> Iterator[None]:
    """
    Makes the folder `path` if need be, and holds it for this process while the block runs; a
    process that ends in any way no longer holds it. A folder made here that stays empty goes again.

    Raises:
        OSError: if it cannot be made or written to, or another process holds it; the message says
            which. Network file systems that know no locks let all in.
    """
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    require_writable_folder(path)
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(
                f"{path} is in use by {_holder(descriptor)}; wait until that ends, or choose "
                "another folder"
            ) from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EBADF, errno.EINVAL):
                raise
        yield
    finally:
        os.close(descriptor)
        with contextlib.suppress(OSError):  # unless they are empty
            for folder in made:
                folder.rmdir()


def holds_folder[**P, Result](
    argument: str,
) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Decorates a function that works in the folder which this argument names: it holds that
    folder, see `held_folder`."""

    def decorate(function: Callable[P, Result]) -> Callable[P, Result]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def holding(*args: P.args, **keywords: P.kwargs) -> Result:
            with held_folder(Path(signature.bind(*args, **keywords).arguments[argument])):
                return function(*args, **keywords)

        return holding

    return decorate


def _holder(descriptor: int) -> str:
    """Who holds a folder, as Linux's /proc tells."""
    status = os.fstat(descriptor)
    device = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}"
    with contextlib.suppress(OSError, IndexError, ValueError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if words[1] == "FLOCK" and words[5] == f"{device}:{status.st_ino}":
                pid = int(words[4])
                command = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                return f"process {pid} ({b' '.join(command[:8]).decode(errors='replace').strip()})"
    return "another process"


DATA = "SPLATPILOT_DATA"
"""Names the folder of captures and meshes."""

SCENES = "SPLATPILOT_SCENES"
"""Names the folder of scenes."""


def data_folder() -> Path | None:
    """The folder of captures and meshes; None where nobody named one."""
    return Path(os.environ[DATA]) if DATA in os.environ else None


def scenes_folder() -> Path:
    """The folder of scenes: `scenes` where nobody named one."""
    return Path(os.environ.get(SCENES, "scenes"))


def cache_folder(*parts: str) -> Path:
    """The folder of what takes long to make again, in the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "splatpilot", *parts)


def find_data(path: Path, what: str, hint: str = "") -> Path:
    """
    Finds a capture or a mesh: here, in the folder of data, or, by its name alone, in a folder of
    that. Prints where, if that is not here.

    Args:
        what: what it is, for the message.
        hint: what to do if it is nowhere.

    Raises:
        FileNotFoundError: if it is nowhere.
    """
    if path.exists():
        return path
    data = data_folder()
    if data is not None:
        within = sorted(data.glob(f"*/{path}")) if len(path.parts) == 1 else []
        for found in (data / path, *within):
            if found.exists():
                print(f"{path} is {found}")
                return found
    where = f"in {data}" if data is not None else f"in the folder that {DATA} names (it is not set)"
    raise FileNotFoundError(
        f"No such file or folder: {path}; expected {what}, here or {where}"
        + (f"; {hint}" if hint else "")
    )


def require_corpus(folder: Path) -> None:
    """
    Raises:
        FileNotFoundError: unless a folder holds a corpus; the message says how to make one.
    """
    if not (folder / "shards").is_dir():
        raise FileNotFoundError(
            f"{folder} holds no corpus; collect one with `splatpilot corpus make --out {folder} "
            "--worlds 18`"
        )


def require_scene(path: str, source: str = "") -> Path:
    """
    Where a scene is: here, or in the folder of scenes.

    Args:
        path: of it.
        source: how to get it.

    Raises:
        FileNotFoundError: if it is in neither; the message says how to get it.
    """
    folder = scenes_folder()
    for place in (Path(path), folder / path):
        if place.exists():
            return place
    raise FileNotFoundError(
        f"No such file or folder: {path}; expected a scene, here or in {folder} (the environment "
        f"variable {SCENES} names that folder); "
        + (source or "reconstruct one with `splatpilot reconstruct`").strip()
    )
