import hashlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
from room import write_room_capture

SCENARIO = """\
world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}
camera: {width: 64, height: 48}
timeout: 0.4
"""
COMMANDS = {
    "fly": (
        "fly --scenario short.yaml --policy straight --overwrite --out out",
        "trajectory.npz scenario.yaml flight.mp4",
    ),
    "benchmark": (
        "benchmark --scenarios short.yaml --seeds 2 --policies straight --jobs 1 --out out",
        "*.yaml rollouts.csv table.csv rollouts/* scenarios/*",
    ),
    "reconstruct": (
        "reconstruct room --overwrite --out out/scene --set iterations=6 --set voxel_size=0.3"
        " --set threads=1 --set checkpoint_every=2 --set initial_gaussians=500"
        " --set lpips_weight=0",
        "scene/*",
    ),
}
"""Arguments, and patterns of the files in `out` that must be equal."""


def execute(words: list[str], folder: Path, limit: int) -> None:
    """Runs a command in this process, in which no file can have more than `limit` bytes."""
    from splatpilot.analysis.commands.main import run

    os.setpgid(0, 0)
    os.environ["OMP_NUM_THREADS"] = "1"
    os.chdir(folder)
    os.dup2(os.open("errors", os.O_WRONLY), 2)
    if limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    sys.argv = ["splatpilot", *words]
    run()


class Command:
    """A command and what it leaves undisturbed."""

    def __init__(self, folder: Path, name: str) -> None:
        words, self._patterns = COMMANDS[name]
        self._words, self._folder = words.split(), folder
        self._context = multiprocessing.get_context("forkserver")
        modules = "commands.main", "benchmark.run_study", "reconstruction.measure_scene"
        self._context.set_forkserver_preload([f"splatpilot.analysis.{name}" for name in modules])
        write_room_capture(folder / "room")
        (folder / "short.yaml").write_text(SCENARIO)
        os.mkfifo(folder / "errors")
        started = time.monotonic()
        assert self.run() == (0, "")
        self.seconds, self.files = time.monotonic() - started, self.digests()
        outputs = [file.stat().st_size for file in folder.rglob("out/**/*") if file.is_file()]
        self.largest = max(outputs)

    def run(self, number: int = 0, after: float = 60.0, limit: int = 0) -> tuple[int | None, str]:
        """Returns exit status and last line of errors; sends a signal `after` so many seconds."""
        errors = os.open(self._folder / "errors", os.O_RDONLY | os.O_NONBLOCK)
        child = self._context.Process(target=execute, args=(self._words, self._folder, limit))
        child.start()
        child.join(after)
        if child.is_alive():
            os.kill(child.pid, number)
        child.join()
        with pytest.raises(ProcessLookupError):
            os.killpg(child.pid, 0)
        with os.fdopen(errors, "rb") as stream:
            text = (stream.read() or b"").decode().replace("\r", "\n").strip()
        assert "Traceback" not in text
        return child.exitcode, text.splitlines()[-1] if text and child.exitcode else ""

    def digests(self) -> dict[str, str]:
        files = [
            f for pattern in self._patterns.split() for f in self._folder.glob(f"out/{pattern}")
        ]
        return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files if f.is_file()}


@pytest.mark.parametrize("name", COMMANDS)
def test_command_that_a_full_disk_or_a_signal_ended_loses_nothing(name, tmp_path):
    command = Command(tmp_path, name)
    shutil.rmtree(tmp_path / "out")
    status, message = command.run(limit=command.largest // 2)
    assert status == 1 and message.startswith("splatpilot: ")
    for number in (signal.SIGKILL, signal.SIGTERM):
        status, message = command.run(number, after=0.5 * command.seconds)
        assert status in (0, -number, 143)
        assert status != 143 or message.startswith("splatpilot: terminated")
    assert command.run() == (0, "")
    assert command.digests() == command.files
    assert not list(tmp_path.rglob("*.partial*"))
