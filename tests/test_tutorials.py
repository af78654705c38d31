"""Follows each tutorial in an empty folder, command by command, with smaller sizes (`SMALLER`).

Text blocks of a page must be printed, and files of its text in `out/` must exist."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatpilot.analysis.commands.main import main

ROOT = Path(__file__).parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
BLOCK = re.compile(r"^```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)

SMALL_WORLD = "--set world.length=9"
SHORT = f"{SMALL_WORLD} --set timeout=2"
SHORT_FLIGHT = f"fly --no-video {SHORT}"
# Per page, each text that the test replaces, and by which. Installations are not repeated.
SMALLER = {
    "first_flight": {
        "git clone REPOSITORY splatpilot && cd splatpilot\n": "",
        ". .venv/bin/activate\n": "",
        "fly --seed": f"{SHORT_FLIGHT} --seed",
        "fly --set world": f"{SHORT_FLIGHT} --set world",
        "fly --scenario": "fly --no-video --scenario",
        "fly --scene ": "fly --set timeout=1 --scene ",
        "make fly\n": f"splatpilot fly --out out/fly {SMALL_WORLD}\n",
    },
    "own_policy": {
        "my_policy fly": "my_policy fly --no-video",
        "sidestep fly": f"sidestep {SHORT_FLIGHT}",
        "P01,P02 --seeds 5": f"P02 --seeds 1 --jobs 1 {SHORT}",
        "P02-sidestep-2-003": "P02-sidestep-2-000",
    },
    "own_environment": {
        "UV_TORCH_BACKEND=cpu make .venv/installed\n": "",
        "spacing=0.5": "spacing=1",
        "36_left": "18_left",
        "width=400 --set height=300": "width=280 --set height=210",
        "iterations=2000": "iterations=50 --set voxel_size=0.1 --set lpips_weight=0",
        "fly --scene": "fly --no-video --set timeout=1 --scene",
    },
    "training": {
        ".venv/bin/uv pip install --python .venv/bin/python gymnasium stable-baselines3\n": "",
        "Env(64, ": "Env(2, ",
        "(64, ": "(2, ",
        "num_worlds=16": "num_worlds=1",
        "range(6)": "range(1)",
        "n_steps=64, batch_size=512": "n_steps=8, batch_size=16",
        "50_000": "16",
        "53248 steps": "16 steps",
        "Env(20, scenario=scenario, num_worlds=20": "Env(2, scenario=scenario, num_worlds=1",
        "< 50": "< 2",
        '"P01", observation=observed, r': "replace(scenario, timeout=1), observation=observed, r",
    },
    "monte_carlo": {
        'length=18", "timeout=20': 'length=9", "timeout=2',
        "samples=10, seeds=2": "samples=2, jobs=1, seeds=1",
        "samples=10, seeds=3": "samples=2, jobs=1, seeds=2",
        "60 flights": "8 flights",
        "2.4,3,4 --seeds 5": f"3,4 --seeds 1 --jobs 1 {SHORT}",
    },
    "crash": {
        "--seeds 5": f"--seeds 1 --jobs 1 {SHORT}",
        "fly --scenario": f"{SHORT_FLIGHT} --scenario",
    },
    "to_hardware": {
        "timeout 15 splatpilot hardware bridge": "splatpilot hardware bridge --set timeout=1",
        "--scenario P02 --policy diffaero": f"--scenario P02 --policy diffaero {SMALL_WORLD}",
        "--out out/vehicle": "--set timeout=2 --out out/vehicle",
        "--log": "--set timeout=2 --log",
        "--patience 60": "--patience 300",
        "trials=10": "trials=1",
        "10 of 10 trials were": "1 of 1 trials were",
    },
}


class Learner:
    """Types the blocks of a page, in the current folder."""

    def __init__(self, capsys: pytest.CaptureFixture[str], url: str) -> None:
        self.names: dict[str, Any] = {"__name__": "tutorial"}
        self.printed, self._capsys, self._url = "", capsys, url
        self._background: list[subprocess.Popen[str]] = []

    def run(self, before: str, language: str, code: str) -> None:
        if saved := re.search(r"Save this as\s+`(\w+\.\w+)`:$", before):
            Path(saved[1]).write_text(code)
        elif language == "text":
            self._expect(code)
        elif language == "python":
            self._capsys.readouterr()
            exec(code, self.names)
            self.printed = self._capsys.readouterr().out
        else:
            assert not language
            for line in code.replace("\\\n", " ").splitlines():
                self._command(shlex.split(line, comments=True))

    def _expect(self, text: str) -> None:
        """Requires the names of each line of a page's output, and its words between digits."""
        for line in text.splitlines():
            words = re.findall(r"[A-Za-z_][A-Za-z_-]+", line)
            assert all(word in self.printed for word in words), (line, self.printed)

    def _command(self, words: list[str]) -> None:
        if words[:1] == ["splatpilot"]:
            if words[1:2] == ["hardware"] and "faults" not in words:
                words = [*words, "--lcm-url", self._url]
            if words[-3:-2] == ["&"]:
                command = [sys.executable, "-m", *(word for word in words if word != "&")]
                self._background.append(subprocess.Popen(command, text=True, stdout=-1))
                return
            self._capsys.readouterr()
            with_help = words[-2:] == ["--set", "help"]
            try:
                assert main(words[1:]) == 0, self._capsys.readouterr().err
            except SystemExit as end:
                assert with_help and not end.code
            self.printed = self._capsys.readouterr().out
        elif words == ["wait"]:
            for process in self._background:
                self.printed += process.communicate(timeout=300)[0]
                assert process.returncode == 0
            self._background.clear()
        elif words:
            assert words[0] in ("cp", "cmp"), words
            subprocess.run(words, check=True)


@pytest.fixture
def clone(tmp_path, monkeypatch, viewer, registered) -> Iterator[Path]:
    """The current folder, with the examples of a clone."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    yield tmp_path
    for name in ("my_policy", "sidestep"):
        sys.modules.pop(name, None)


def test_each_tutorial_is_followed_and_short():
    pages = {page.stem: page.read_text() for page in TUTORIALS.glob("*.md")}
    assert set(pages) == set(SMALLER)
    for name, text in pages.items():
        assert len(text.splitlines()) <= 100, name
        assert len(text.split()) <= 450, name


@pytest.mark.parametrize("name", list(SMALLER))
def test_results_are_as_promised(name, clone, capsys, request):
    text = (TUTORIALS / f"{name}.md").read_text()
    for long, short in SMALLER[name].items():
        assert long in text, long
        text = text.replace(long, short)
    url = request.getfixturevalue("udp_url") if name == "to_hardware" else ""
    learner = Learner(capsys, url)
    parts = BLOCK.split(text)
    for before, language, code in zip(parts[::3], parts[1::3], parts[2::3], strict=False):
        learner.run(before.strip(), language, code)
    for promised in re.findall(r"`(out/[\w./-]+)`", "".join(parts[::3])):
        assert promised.endswith("/errors/") or Path(promised).exists(), promised
