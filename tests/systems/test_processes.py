import os
import signal
from pathlib import Path

import pytest

from splatpilot.systems.processes import map_processes


def _square(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def _killed(folder: Path) -> str:
    """The first to come here marks the folder and is killed; later ones end."""
    try:
        (folder / "mark").touch(exist_ok=False)
    except FileExistsError:
        return "ended"
    os.kill(os.getpid(), signal.SIGKILL)
    return "never"


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_those_of_the_function(jobs):
    """Every piece of work has its result once; one job works in this process, several in others."""
    results = list(map_processes(_square, range(7), jobs))
    assert sorted(square for square, _ in results) == [n * n for n in range(7)]
    assert ({pid for _, pid in results} == {os.getpid()}) == (jobs == 1)


def test_killed_process_is_named_and_the_next_call_works(tmp_path):
    """A process that is killed ends the call with the remedy; the same call again goes on."""
    with pytest.raises(OSError, match=r"was killed.*run the same command again, with fewer --jobs"):
        list(map_processes(_killed, [tmp_path] * 3, jobs=2))
    assert list(map_processes(_killed, [tmp_path] * 3, jobs=2)) == ["ended"] * 3
