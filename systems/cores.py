"""The processor cores that work can be spread over."""

import os


def available_cores() -> int:
    """The number of cores that this process may run on, where the system tells; all, elsewhere."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
