"""Work in processes, each on a core of its own."""

import functools
import os
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable
from typing import Any

_WATCH_PERIOD = 0.5  # [s]


class WorkerEndedError(OSError):
    """A process that worked for this one was ended from outside, or by native code."""


def map_processes[Work, Result](
    function: Callable[[Work], Result], work: Iterable[Work], jobs: int
) -> Generator[Result]:
    """
    Yields `function` of each piece of work as it ends, in any order. The processes end with this
    one, even where it is killed.

    Args:
        function: of the module's level, as processes receive it by name.
        work: taken as processes become free, and one ahead, so that none waits.
        jobs: processes, 1 or more; with one, all is done in this one.

    Raises:
        WorkerEndedError: if a process was killed; all that was yielded before is good.
    """
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    parallel: Any = Parallel(jobs, return_as="generator_unordered", pre_dispatch=str(jobs + 1))
    if jobs > 1:
        function = functools.partial(_attended, os.getpid(), function)
    results = parallel(map(delayed(function), work))
    try:
        for result in results:  # noqa: UP028 (`yield from` would close it, with a warning)
            yield result
    except TerminatedWorkerError:
        raise WorkerEndedError(
            "a worker process was killed, perhaps for want of memory; what had ended is kept: run "
            "the same command again, with fewer --jobs if it repeats"
        ) from None
    finally:
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            results.close()  # joblib warns that what nobody waits for any more is given up
        if jobs > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)


def run_apart[Work, Result](what: str, function: Callable[[Work], Result], work: Work) -> Result:
    """
    Returns `function` of `work`, called in a process of its own: native code may end it where it
    should raise, or raise a RuntimeError of any meaning, as pycolmap does when the disk is full.

    Args:
        what: it does, and where, for messages.
        function: of the module's level, as the process receives it by name.

    Raises:
        OSError: if the process was ended or raised a RuntimeError.
    """
    try:
        [result] = map_processes(function, [work], 2)
    except (WorkerEndedError, RuntimeError) as error:
        why = "its process was ended" if isinstance(error, WorkerEndedError) else f"{error}"
        raise OSError(
            f"{what}: {why}, perhaps for want of room on the disk or of memory; make room and run "
            "the same command again"
        ) from error
    return result


def _attended[Work, Result](parent: int, function: Callable[[Work], Result], work: Work) -> Result:
    _end_with(parent)
    return function(work)


@functools.cache
def _end_with(parent: int) -> None:
    """Ends this process soon after its parent, the process `parent`, has ended."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_PERIOD)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def available_cores() -> int:
    """The number of cores that this process may run on, where the system tells; all, elsewhere."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
