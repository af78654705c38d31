"""Processes, threads and devices that compute."""

import ctypes
import functools
import importlib.util
import os
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from splatpilot.systems.common.validation import require

_WATCH_PERIOD = 0.5  # [s]


class WorkerEndedError(OSError):
    """A worker process was ended from outside, or by native code."""


def available_cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_processes[Work, Result](
    function: Callable[[Work], Result], work: Iterable[Work], jobs: int
) -> Generator[Result]:
    """Yields `function` of each piece of work as it ends, in any order.

    The `jobs` worker processes, this one if it is 1, take work as they become free, and one ahead.
    They receive the function by name, from its module, and end with this one, even if it is killed.
    """
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    parallel: Any = Parallel(jobs, return_as="generator_unordered", pre_dispatch=str(jobs + 1))
    if jobs > 1:
        function = functools.partial(_call_watched, os.getpid(), function)
    results = parallel(map(delayed(function), work))
    try:
        for result in results:  # noqa: UP028 (`yield from` would close it, with a warning)
            yield result
    except TerminatedWorkerError:
        raise WorkerEndedError(
            "a worker process was killed, perhaps out of memory; finished work is kept: run "
            "the same command again, with fewer --jobs if it repeats"
        ) from None
    finally:
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            results.close()  # joblib warns about work that is given up.
        if jobs > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)


def run_in_subprocess[Work, Result](
    what: str, function: Callable[[Work], Result], work: Work
) -> Result:
    """Returns `function` of `work`, see `map_processes`, called in another process that native code
    may end; messages begin with `what`."""
    try:
        [result] = map_processes(function, [work], 2)
    except (WorkerEndedError, RuntimeError) as error:
        why = "its process was ended" if isinstance(error, WorkerEndedError) else f"{error}"
        remedy = "perhaps out of disk space or memory; free some and run the command again"
        raise OSError(f"{what}: {why}, {remedy}") from error
    return result


def _call_watched[Work, Result](
    parent: int, function: Callable[[Work], Result], work: Work
) -> Result:
    _end_with(parent)
    return function(work)


@functools.cache
def _end_with(parent: int) -> None:
    """Ends this process soon after the process `parent` has ended."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # parameters of glibc's `mallopt`, see malloc.h
_MAX_THRESHOLD = 32 << 20  # [bytes]


def require_device(device: str) -> None:
    """Raises ValueError unless torch can compute on `cpu`, `cuda` or `cuda:1`."""
    import torch

    kind = device.partition(":")[0]
    require(kind in ("cpu", "cuda"), "device", "cpu or cuda", repr(device))
    if kind == "cuda" and not torch.cuda.is_available():
        built = torch.version.cuda or "the CPU alone"
        raise ValueError(
            f"device must be cpu, got {device!r}; this PyTorch, built for {built}, finds no GPU: "
            "install a driver and a PyTorch for it"
        )


def require_renderer(device: str) -> None:
    """Raises ValueError unless Gaussians can be rendered on a device; a GPU needs gsplat."""
    require_device(device)
    if device.startswith("cuda") and importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device must be cpu, got {device!r}; to render on it, pip install 'splatpilot[cuda]'"
        )


def keep_freed_memory() -> None:
    """Lets glibc, if it is the C library, keep freed memory of tensors for the next."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _MAX_THRESHOLD)
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limits torch to one thread in the block: sums depend on the number of threads."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
