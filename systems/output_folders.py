"""Folders that runs write to: each is one process's at a time, and one configuration's."""

import contextlib
import errno
import fcntl
import functools
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatpilot.systems.configuration import dump_config, load_config
from splatpilot.systems.files import require_writable_folder, written_atomically


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
