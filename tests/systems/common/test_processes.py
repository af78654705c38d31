import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatpilot.systems.common.processes import (
    available_cores,
    map_processes,
    require_device,
    require_renderer,
    run_in_subprocess,
)


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_those_of_the_function_and_may_be_given_up(jobs, recwarn):
    def square(number: int) -> tuple[int, int]:  # Workers need not import this module for it.
        return number * number, os.getpid()

    results = list(map_processes(square, range(7), jobs))
    assert sorted(square for square, _ in results) == [n * n for n in range(7)]
    assert ({pid for _, pid in results} == {os.getpid()}) == (jobs == 1)
    given_up = map_processes(square, range(20), jobs)
    assert next(given_up)[0] in [n * n for n in range(20)]
    given_up.close()
    assert not recwarn.list


def test_killed_process_is_named_and_the_next_call_works(tmp_path):
    def killed(folder: Path) -> str:
        """Kills its process on the first call for a folder."""
        try:
            (folder / "mark").touch(exist_ok=False)
        except FileExistsError:
            return "ended"
        os.kill(os.getpid(), signal.SIGKILL)
        return "never"

    with pytest.raises(OSError, match=r"was killed.*run the same command again, with fewer --jobs"):
        list(map_processes(killed, [tmp_path] * 3, jobs=2))
    assert list(map_processes(killed, [tmp_path] * 3, jobs=2)) == ["ended"] * 3


def _is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, pathlib, time\n"
        "from splatpilot.systems.common.processes import map_processes\n"
        "def work(seconds):\n"
        f"    (pathlib.Path({str(tmp_path)!r}) / f'{{os.getpid()}}.worker').touch()\n"
        "    time.sleep(seconds)\n"
        "list(map_processes(work, [600.0, 0.2, 0.2], jobs=2))\n"
    )
    parent = subprocess.Popen([sys.executable, script])
    deadline = time.monotonic() + 120.0
    while len(workers := [int(p.stem) for p in tmp_path.glob("*.worker")]) < 2:
        assert parent.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    while any(map(_is_running, workers)):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.1)


def test_work_in_a_subprocess():
    def work(error):
        if error is None:
            os.abort()
        raise error("no factory")

    assert run_in_subprocess("a: counting", lambda _: os.getpid(), 3) != os.getpid()
    message = "a: counting: {}, perhaps out of disk space"
    for given, error, told in (
        (ValueError, ValueError, "no factory"),
        (RuntimeError, OSError, message.format("no factory")),
        (None, OSError, message.format("its process was ended")),
    ):
        with pytest.raises(error, match=told):
            run_in_subprocess("a: counting", work, given)


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 5, 7})
    assert available_cores() == 3


@pytest.mark.parametrize("device", ["cuda", "cuda:1", "gpu"])
def test_only_the_cpu_is_a_device_without_a_gpu(device, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for require in (require_device, require_renderer):
        require("cpu")
        with pytest.raises(ValueError, match=rf"device must be cpu.*, got '{device}'"):
            require(device)


def test_rendering_on_a_gpu_needs_gsplat(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    require_device("cuda")
    with pytest.raises(ValueError, match=r"splatpilot\[cuda\]"):
        require_renderer("cuda")


PASSES = """
import resource
import numpy as np
from splatpilot.systems.common.processes import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        kept = [np.full(4_000_000, 1, np.float32) for _ in range(4)]
        del kept
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

given_back = min(faults() for _ in range(3))
keep_freed_memory()
# The minimum of several: a fragmented heap may still grow.
print(given_back, min(faults() for _ in range(6)))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an option of glibc")
def test_freed_memory_is_kept():
    # The initial value of glibc, which raises it at times, so far that nothing is cleared.
    options = os.environ | {"MALLOC_MMAP_THRESHOLD_": "131072", "NUMPY_MADVISE_HUGEPAGE": "0"}
    printed = subprocess.check_output([sys.executable, "-c", PASSES], text=True, env=options)
    given_back, kept = map(int, printed.split())
    assert given_back > 100_000 > 100 > kept
