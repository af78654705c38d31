import re
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import POLICIES

EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = sorted(EXAMPLES.glob("*.py"))
SHORT = "world: {length: 9, width: 6}\ntimeout: 12\n"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example in an empty folder; returns its output."""

    def run(name: str, *words: object) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def number(pattern: str, text: str) -> float:
    """Returns the number that a pattern matches in a text."""
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_each_is_short_begins_with_its_command_and_has_a_test(file):
    docstring = file.read_text().split('"""')[1]
    assert re.search(rf"\n    .*\b{file.stem}\b", docstring)
    # A whole trainer is longer.
    assert len(file.read_text().splitlines()) <= (150 if file.stem == "train_ppo" else 75)
    assert f'"{file.name}"' in Path(__file__).read_text()


def test_flight_by_hand(run):
    out = run("flight_by_hand.py", "--length", 9)
    assert "s at the goal" in out
    assert number(r"clearance (\S+) m", out) > 0
    assert 20 < number(r"mean (\d+)", out) < 240


def test_splats_behind_drake(opengl, run, tmp_path):
    red = []
    for seconds in (0.2, 0.5):
        words = "--width", 240, "--seconds", seconds, "--out", tmp_path / "sphere.png"
        run("splats_behind_drake.py", *words)
        image = np.array(cv2.imread(str(tmp_path / "sphere.png")), dtype=int)
        is_red = image[..., 2] > 100 + image[..., :2].max(axis=-1)
        assert image[~is_red].std() > 20
        red.append(int(is_red.sum()))
    assert red[0] == 0 < red[1]


def test_own_policy_flies_by_its_configuration_and_by_an_unregistered_entry(
    tmp_path, monkeypatch, capsys
):
    own = (EXAMPLES / "own_policy.py").read_text()
    (tmp_path / "own_policy.py").write_text(own)
    kind = 'PolicyEntry(*build, speed_field="speed")'
    own = own.replace("sp.register_policy(", "build = (").replace("Sidestep", "Loose")
    own += f"\nfrom splatpilot.diagrams.flight.policies import PolicyEntry\nKIND = {kind}\n"
    (tmp_path / "loose_policy.py").write_text(own)
    (tmp_path / "short.yaml").write_text(SHORT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(POLICIES, "_entries", dict(POLICIES._entries))
    policies = "sidestep=own_policy:SidestepConfig,mine=loose_policy:KIND"
    words = ["--import", "own_policy", "benchmark", "--policies", policies, "--seeds", "1"]
    assert main([*words, "--scenarios", "short.yaml", "--jobs", "1", "--out", "study"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"sidestep +2 +1/1", out) and re.search(r"mine +2 +1/1", out)


def test_lqr_hover(run):
    out = run("lqr_hover.py")
    assert number(r"from (\S+) s on", out) < 5
    assert number(r", (\S+) mm", out) < 0.5


def test_train_ppo(run):
    sizes = ("--envs", 4, "--worlds", 1, "--tests", 1, "--minutes", 1e-4)
    for observation in (("state", "goal", "obstacle"), ("depth", "state", "goal")):
        out = run("train_ppo.py", "--observation", *observation, *sizes)
        assert number(r"(\d+) steps", out) == 256
        assert 0.0 <= number(r"test success (\S+)", out) <= 1.0
