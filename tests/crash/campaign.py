"""Rounds: a command is ended at some moment in some way, then given again, and what it leaves is
compared with what it leaves where nobody ends it."""

import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from crash.verbs import VERBS, Verb, prepare

WAYS = "kill -9", "SIGTERM", "full disk", "no permission"
_BLOCKS = ",".join(f"-{name}" for name in ("dac_override", "dac_read_search"))
_MARK = "SPLATPILOT_CRASH_ROUND"
_PROGRAM = "from splatpilot.analysis.commands.main import run; run()"
_PATIENCE = 20.0  # [s], after which what a command has started must have ended with it


class Round(NamedTuple):
    """What came of a round."""

    verb: str
    way: str
    moment: float
    """When it was ended, as a fraction of the command's time; of full disks the largest file that
    there was room for, as a fraction of the largest that the command writes."""
    wrong: str
    """What is wrong; empty where nothing is."""
    missed: bool
    """Whether the command had ended by itself before that moment, or had room enough."""


class Campaign:
    """Folders with what the commands read, and what each leaves that is not ended."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.whole = root / "whole"
        self.whole.mkdir()
        prepare(self.whole)
        self._expected: dict[str, tuple[dict[str, str], float, int]] = {}

    def _folder(self, name: str) -> Path:
        """A folder for a command, always at the same path: scenes say which capture they are of."""
        folder = self.root / "round"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.whole, folder)
        if VERBS[name].reads_scene:
            if not (self.root / "scene").is_dir():
                words = f"reconstruct {folder}/room --out {self.root}/scene --iterations 0".split()
                made = _run(words, folder)
                assert made.returncode == 0, made.stderr
            shutil.copytree(self.root / "scene", folder / "scene")
        return folder

    def expected(self, name: str) -> tuple[dict[str, str], float, int]:
        """The digests of what a command leaves, its time [s] and its largest file [bytes]."""
        if name not in self._expected:
            folder, started = self._folder(name), time.monotonic()
            ended = _run(VERBS[name].words(folder), folder)
            assert ended.returncode == 0, f"{name}: {ended.stderr}"
            took = time.monotonic() - started
            files = [file for file in (folder / "out").rglob("*") if file.is_file()]
            largest = max(file.stat().st_size for file in files)
            self._expected[name] = digests(VERBS[name], folder), took, largest
        return self._expected[name]

    def round(self, name: str, way: str, seed: int) -> Round:
        """One round; the seed decides the moment."""
        expected, took, largest = self.expected(name)
        moment = float(np.random.default_rng([seed, *name.encode()]).random())
        folder = self._folder(name)
        words = VERBS[name].words(folder)
        if way == "full disk":
            limit = int(200 * (largest / 200) ** moment)
            ended = _run(words, folder, limit=limit)
            wrong = _refusal(ended, folder)
        else:
            ended = _run(words, folder, way=way, after=max(0.5, moment * took))
            wrong = _refusal(ended, folder) if way == "no permission" else _signal(ended, way)
        wrong = wrong or _alive(folder)
        again = _run(words, folder)
        if not wrong and again.returncode != 0:
            wrong = f"the same command again: {again.stderr.strip().splitlines()[-1:]}"
        if not wrong:
            found = digests(VERBS[name], folder)
            differing = sorted(
                file for file in expected | found if expected.get(file) != found.get(file)
            )
            wrong = f"differs: {differing[:3]}" if differing else ""
        left = [path.name for path in folder.rglob("*.partial*")]
        wrong = wrong or (f"left: {left[:3]}" if left else "")
        return Round(name, way, round(moment, 3), wrong, ended.returncode == 0)


def digests(verb: Verb, folder: Path) -> dict[str, str]:
    """What must be the same of what a command leaves."""
    out = folder / "out"
    files = [file for pattern in verb.same.split() for file in out.glob(pattern)]
    files += [file for pattern in verb.changed.split() for file in folder.glob(pattern)]
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        for file in files
        if file.is_file()
    }


def _run(
    words: list[str], folder: Path, *, way: str = "", after: float = 0.0, limit: int = 0
) -> subprocess.CompletedProcess[str]:
    """Runs a command, and ends it `after` so many seconds, unless it has ended before, in this
    `way`; or in a world in which no file can have more bytes than `limit`."""
    command = [sys.executable, "-c", _PROGRAM, *words]
    if way == "no permission" and os.geteuid() == 0:  # whom nobody forbids anything
        command = ["setpriv", "--bounding-set", _BLOCKS, "--inh-caps", _BLOCKS, *command]
    environment = os.environ | {_MARK: str(folder), "OMP_NUM_THREADS": "1", "TMPDIR": str(folder)}

    def forbid() -> None:
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    # What it says goes through a pipe: a file would be as full as any other.
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=forbid,
    )
    said: list[str] = []
    assert process.stderr is not None
    listener = threading.Thread(target=said.extend, args=(process.stderr,), daemon=True)
    listener.start()
    if way:
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            if way == "no permission":
                _set_writable(folder, False)
            else:
                process.send_signal(signal.SIGKILL if way == "kill -9" else signal.SIGTERM)
    process.wait()
    listener.join(1.0)  # longer where something that it has started lives on
    _set_writable(folder, True)
    return subprocess.CompletedProcess(words, process.returncode, "", "".join(said))


def _set_writable(folder: Path, writable: bool) -> None:
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o755 if writable else 0o555)


def _last_line(ended: subprocess.CompletedProcess[str]) -> str:
    lines = ended.stderr.replace("\r", "\n").strip().splitlines()
    return lines[-1] if lines else ""


def _refusal(ended: subprocess.CompletedProcess[str], folder: Path) -> str:
    """What is wrong with the answer to what cannot be written."""
    said = _last_line(ended)
    if "Traceback" in ended.stderr:
        return f"traceback: {said}"
    if ended.returncode == 0:
        return ""
    if ended.returncode != 1 or not said.startswith("splatpilot: ") or str(folder) not in said:
        return f"status {ended.returncode}: {said}"
    return ""


def _signal(ended: subprocess.CompletedProcess[str], way: str) -> str:
    """What is wrong with the answer to a signal."""
    if way == "kill -9" or ended.returncode == 0:
        return ""
    said = _last_line(ended)
    if "Traceback" in ended.stderr or "***" in ended.stderr:
        return f"traceback: {said}"
    early = ended.returncode == -signal.SIGTERM and not said  # before it could answer
    if not early and (ended.returncode, said) != (143, "splatpilot: terminated"):
        return f"status {ended.returncode}: {said}"
    return ""


def _alive(folder: Path) -> str:
    """What still runs of what was started for a folder."""
    mark, running, over = f"{_MARK}={folder}".encode(), [], time.monotonic() + _PATIENCE
    while time.monotonic() < over:
        running = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (process / "environ").read_bytes().split(b"\0"):
                    running.append(process.name)
            except OSError:
                continue
        if not running:
            return ""
        time.sleep(0.2)
    return f"still alive: {len(running)} processes"
