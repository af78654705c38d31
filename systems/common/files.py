"""Atomic writes, locked output folders, and the folders that environment variables name.

A file is written under a temporary name, `.STEM.HOST.PID.partial.SUFFIX`, next to its final one.
A killed process leaves it there; `require_writable_folder` removes such leftovers of this host.
"""

import contextlib
import csv
import errno
import fcntl
import functools
import inspect
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

DATA = "SPLATPILOT_DATA"
"""Environment variable with the folder of captures and meshes."""

SCENES = "SPLATPILOT_SCENES"
"""Environment variable with the folder of scenes."""

SHIPPED_SCENES = Path(__file__).parents[2] / "scenes"
"""The folder of the scenes of this package."""

_HOST = re.sub(r"[^\w-]", "-", platform.node()) or "host"
_LEFTOVER = re.compile(rf"\.(?P<name>.+)\.{re.escape(_HOST)}\.(?P<pid>\d+)\.partial(\..*)?")
_REPLACED = ".replaced"
_DISK_FULL = (None, errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # None: libraries without a number


class _UnwritableError(OSError):
    """An OSError whose message already names the file."""


@contextmanager
def written_atomically(
    path: str | Path, check: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yields a temporary path next to `path` that is renamed to `path` when the block ends.

    An exception in the block removes the temporary file; `path` stays. An OSError names `path`.
    `check` raises OSError for a file that its writer has silently left incomplete.
    """
    path = Path(path)
    partial = _temporary(path, path.stem, path.suffix)  # Many writers choose the format by suffix.
    try:
        with _naming(path, partial):
            yield partial
            _flush(partial)
            if check is not None:
                check(partial)
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file, atomically."""
    with written_atomically(path) as partial:
        partial.write_text(text)


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes rows as CSV, atomically, with the columns of all of them."""
    rows = list(rows)
    columns = dict.fromkeys(column for row in rows for column in row)
    with written_atomically(path) as partial, partial.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


@contextmanager
def folder_written_atomically(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yields a temporary folder next to `path` that is renamed to `path` when the block ends.

    An exception in the block removes the temporary folder. An OSError names `path`. A folder at
    `path` stays, unless `replace` is true.
    """
    path = path.resolve()  # of a link, what it names
    partial, replaced = _temporary(path, path.name), _temporary(path, path.name, _REPLACED)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with _naming(path, partial):
            partial.mkdir(parents=True)
            yield partial
            for file in partial.rglob("*"):
                _flush(file)
            if replace and path.is_dir():
                path.rename(replaced)
            try:
                partial.rename(path)
            except OSError as error:
                if replaced.exists() or error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
    finally:
        if replaced.exists() and not path.exists():
            replaced.rename(path)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Removes the temporary files of processes of this host that have ended; what they were about
    to replace returns."""
    for path in folder.iterdir():
        match = _LEFTOVER.fullmatch(path.name)
        if match is None or _is_running(int(match["pid"])):
            continue
        target = path.with_name(match["name"])
        if path.name.endswith(_REPLACED) and not target.exists():
            path.rename(target)
        elif path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def require_existing(path: Path, what: str) -> None:
    """Raises FileNotFoundError, saying that `what` is expected, if nothing is at `path`."""
    if not path.exists():
        raise FileNotFoundError(f"No such file or folder: {path}; expected {what}")


def require_unused(path: Path, overwrite: bool) -> None:
    """Raises FileExistsError for a file or a folder with content, unless it may be overwritten."""
    used = path.exists()
    if path.is_dir():
        used = any(_LEFTOVER.fullmatch(file.name) is None for file in path.iterdir())
    if used and not overwrite:
        raise FileExistsError(
            f"{path} is there already; choose another --out, or replace it with --overwrite"
        )


def require_writable_folder(path: Path) -> None:
    """Makes the folder `path` if it is missing, and removes leftovers of ended processes."""
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


def claim_folder(file: Path, config: Any, overwrite: bool = False) -> str:
    """Writes `config` to `file`, whose folder belongs to it from then on, and returns it as YAML.
    Raises ValueError for a folder with another configuration, or with files but without one, unless
    `overwrite` is true."""
    from splatpilot.systems.common.config import dump_config, load_config  # imports Drake

    require_writable_folder(file.parent)
    text = dump_config(config)
    if file.exists() and not overwrite:
        found = dump_config(load_config(type(config)(), file))
        if found != text:
            ours = text.splitlines()
            other = next((line for line in found.splitlines() if line not in ours), "").strip()
            raise ValueError(
                f"{file} holds another configuration{f', with {other}' if other else ''}; choose "
                "another --out, or resume with the same configuration"
            )
    others = sorted(p.name for p in file.parent.iterdir() if not p.name.startswith("."))
    if others and not file.exists() and not overwrite:
        raise ValueError(
            f"{file.parent} must be empty or hold {file.name}, got {others[0]}; choose another "
            "--out, or an empty folder"
        )
    with written_atomically(file) as partial:
        partial.write_text(text)
    return text


@contextmanager
def locked_folder(path: Path) -> Iterator[None]:
    """Locks the folder `path`, made if it is missing, for this process while the block runs; raises
    OSError if another has locked it. A folder that was made here and stays empty is removed."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    require_writable_folder(path)
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(
                f"{path} is in use by another process; wait until it ends, or choose another folder"
            ) from None
        except OSError:
            pass  # Network file systems may have no locks.
        yield
    finally:
        os.close(descriptor)
        with contextlib.suppress(OSError):  # not empty
            for folder in made:
                folder.rmdir()


def locks_folder[**P, Result](
    argument: str,
) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Decorates a function to lock the folder that its argument of this name gives."""

    def decorate(function: Callable[P, Result]) -> Callable[P, Result]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def holding(*args: P.args, **keywords: P.kwargs) -> Result:
            with locked_folder(Path(signature.bind(*args, **keywords).arguments[argument])):
                return function(*args, **keywords)

        return holding

    return decorate


def data_folder() -> Path | None:
    """Returns the folder of captures and meshes, None if it is not set."""
    return Path(os.environ[DATA]) if DATA in os.environ else None


def scenes_folder() -> Path:
    """Returns the folder of scenes, `scenes` if it is not set."""
    return Path(os.environ.get(SCENES, "scenes"))


def cache_folder(*parts: str) -> Path:
    """Returns a folder in the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "splatpilot", *parts)


def find_data(path: Path, what: str, hint: str = "") -> Path:
    """Finds a capture or a mesh: here, in the folder of data or, by name, in a folder of that.

    Prints the path unless it is here. If it is missing, FileNotFoundError has `what` and `hint`.
    """
    if path.exists():
        return path
    where = f"in the folder that {DATA} names (it is not set)"
    if (data := data_folder()) is not None:
        within = sorted(data.glob(f"*/{path}")) if len(path.parts) == 1 else []
        for found in filter(Path.exists, (data / path, *within)):
            print(f"{path} is {found}")
            return found
        where = f"in {data}"
    message = f"No such file or folder: {path}; expected {what}, here or {where}"
    raise FileNotFoundError(f"{message}; {hint}" if hint else message)


def require_corpus(folder: Path) -> None:
    """Raises FileNotFoundError unless a folder holds a corpus."""
    if not (folder / "shards").is_dir():
        raise FileNotFoundError(
            f"{folder} holds no corpus; collect one with `splatpilot corpus make --out {folder} "
            "--worlds 18`"
        )


def locate_scene(path: str) -> Path | None:
    """Finds what is at `path` here, in the folder of scenes, or among those of this package."""
    found = (folder / path for folder in (Path(), scenes_folder(), SHIPPED_SCENES))
    return next((scene for scene in found if scene.exists()), None)


def require_scene(path: str, source: str = "") -> Path:
    """Finds a scene, see `locate_scene`; `source` says how to get a missing one."""
    if found := locate_scene(path):
        return found
    source = source.strip() or "reconstruct one with `splatpilot reconstruct`"
    raise FileNotFoundError(
        f"No such file or folder: {path}; expected a scene, here or in {scenes_folder()} (the "
        f"environment variable {SCENES} names that folder); {source}"
    )


def _temporary(path: Path, stem: str, suffix: str = "") -> Path:
    return path.with_name(f".{stem}.{_HOST}.{os.getpid()}.partial{suffix}")


@contextmanager
def _naming(path: Path, partial: Path) -> Iterator[None]:
    """Adds `path` to errors about `partial`; libraries do not name the file if the disk is full."""
    try:
        yield
    except _UnwritableError:
        raise
    except OSError as error:
        if error.filename is not None and not str(error.filename).startswith(str(partial)):
            raise  # It is about another file.
        remedy = "make room" if error.errno in _DISK_FULL else "is the folder writable?"
        reason = error.strerror or str(error)
        raise _UnwritableError(f"{path}: cannot be written ({reason}); {remedy}") from error


def _flush(path: Path) -> None:
    """Writes a file to the disk: some file systems only then say that it is full."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
