"""What benchmarks share: timing, memory, and the machine's description."""

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from splatpilot import _native

REPEATS = 30


def milliseconds(call: Callable[[], object], repeats: int = REPEATS) -> tuple[float, float]:
    """Minimum and median CPU time of the process, after one call that does not count.

    With one thread that is what the wall clock shows on an idle machine; on a busy one it does not
    count the waiting.
    """
    durations = []
    call()
    for _ in range(repeats):
        start = time.process_time()
        call()
        durations.append(1e3 * (time.process_time() - start))
    return min(durations), float(np.median(durations))


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Minimum CPU time of the process [s], after one call that does not count."""
    return 1e-3 * milliseconds(call, repeats)[0]


def machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines()
                 if line.startswith("model name")]  # fmt: skip
        model = names[0] if names else model
    levels = ", ".join(_native.simd_levels())
    return (
        f"{model}, {os.cpu_count()} cores, {platform.platform()}, SIMD levels {levels}, Python "
        f"{platform.python_version()}, torch {torch.__version__}, load {os.getloadavg()[0]:.1f}"
    )


def peak_growth(call: Callable[[], object]) -> float:
    """MiB by which the resident memory peaks during a first call; NaN without Linux's /proc."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not reset.exists():
        return float("nan")

    def value(key: str) -> float:
        line = next(x for x in status.read_text().splitlines() if x.startswith(key))
        return int(line.split()[1]) / 1024

    reset.write_text("5")  # the peak starts again from here
    before = value("VmRSS")
    call()
    return value("VmHWM") - before


def row(*cells: object) -> None:
    """Prints a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def header(*cells: str) -> None:
    print()
    row(*cells)
    print("|---" * len(cells) + "|", flush=True)
