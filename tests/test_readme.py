import ast
import re
import runpy
import tomllib
from pathlib import Path

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.simulation import Outcome

README = Path(__file__).parents[1] / "README.md"


def test_its_python_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(POLICIES, "_entries", dict(POLICIES._entries))
    policy, flight, training = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    for text, small in (
        ("Env(16, ", "Env(1, "),
        ("n_steps=64", "n_steps=2"),
        ("200_000", "2"),
        ("progress_bar=True", "progress_bar=False"),  # which needs rich
    ):
        assert text in training
        training = training.replace(text, small)
    Path("my_policy.py").write_text(policy)
    Path("flight.py").write_text("from my_policy import *\n" + flight)
    Path("training.py").write_text(training)
    runpy.run_path("training.py")
    capsys.readouterr()
    runpy.run_path("flight.py")
    summary = ast.literal_eval(capsys.readouterr().out)
    assert summary["outcome"] in set(Outcome) and summary["path_length_m"] > 1.0
    command = re.search(r"splatpilot (fly --policy my_policy.*)", README.read_text())
    assert command is not None
    assert main([*command[1].split(), "--set", "timeout=1", "--out", "flight"]) == 0


def test_extras_are_those_of_the_package():
    listed = re.search(r"Extras:.*?\n\n", README.read_text(), re.DOTALL)
    assert listed is not None
    project = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev"}
    assert set(re.findall(r"`(\w+)`", listed[0])) == extras


def test_it_is_two_screens():
    assert len(README.read_text().splitlines()) <= 150
