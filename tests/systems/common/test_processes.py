import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatpilot.systems.common.processes import available_cores, map_processes, run_in_subprocess


def _square(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def _killed(folder: Path) -> str:
    """Kills its process on the first call for a folder."""
    try:
        (folder / "mark").touch(exist_ok=False)
    except FileExistsError:
        return "ended"
    os.kill(os.getpid(), signal.SIGKILL)
    return "never"


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_those_of_the_function(jobs):
    results = list(map_processes(_square, range(7), jobs))
    assert sorted(square for square, _ in results) == [n * n for n in range(7)]
    assert ({pid for _, pid in results} == {os.getpid()}) == (jobs == 1)


def _slow(number: int) -> int:
    time.sleep(0.2 * number)
    return number


def test_closing_early_gives_no_warning(recwarn):
    results = map_processes(_slow, range(6), jobs=2)
    assert next(results) == 0
    results.close()
    assert not recwarn.list
    assert sorted(map_processes(_slow, range(2), jobs=2)) == [0, 1]


def test_killed_process_is_named_and_the_next_call_works(tmp_path):
    with pytest.raises(OSError, match=r"was killed.*run the same command again, with fewer --jobs"):
        list(map_processes(_killed, [tmp_path] * 3, jobs=2))
    assert list(map_processes(_killed, [tmp_path] * 3, jobs=2)) == ["ended"] * 3


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


def _abort(work):
    if work == "abort":
        os.abort()
    if work == "refuse":
        raise ValueError(f"{work}: no")
    if work == "fail":
        raise RuntimeError("no factory")
    return work, os.getpid()


def test_work_in_a_subprocess():
    work, process = run_in_subprocess("a: counting", _abort, "count")
    assert work == "count" and process != os.getpid()
    with pytest.raises(ValueError, match="refuse: no"):
        run_in_subprocess("a: counting", _abort, "refuse")
    for work, why in (("abort", "its process was ended"), ("fail", "no factory")):
        with pytest.raises(OSError, match=f"a: counting: {why}, perhaps out of disk space"):
            run_in_subprocess("a: counting", _abort, work)


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 5, 7})
    assert available_cores() == 3
