import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from splatpilot.diagrams.flight.simulation import Outcome

README = Path(__file__).parents[1] / "README.md"


def test_the_policy_and_the_flight_in_python_run(tmp_path):
    policy, flight = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "my_policy.py").write_text(policy)
    (tmp_path / "flight.py").write_text("from my_policy import *\n" + flight)
    flown = subprocess.run(
        [sys.executable, "flight.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    summary = ast.literal_eval(flown.stdout)
    assert summary["outcome"] in set(Outcome) and summary["path_length_m"] > 1.0


def test_extras_are_those_of_the_package():
    table = re.search(r"\| extra \|.*?\n\n", README.read_text(), re.DOTALL)
    assert table is not None
    project = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"]) - {"dev"}
    named = re.findall(r"^\|(.*?)\|", table[0], re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", "".join(named))) == extras


def test_it_is_two_screens():
    assert len(README.read_text().splitlines()) <= 150
