"""Code of others that flies in a study."""

import sys

import pytest
import yaml

from splatpilot.analysis.benchmark.study_folder import foreign_code
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario

POLICY = """
from dataclasses import dataclass

from pydrake.systems.framework import LeafSystem

import splatpilot
from straying.speed import SPEED


class Straying(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("velocity", 3, lambda _, y: y.SetFromVector([SPEED, 0, 0]))


@dataclass
class StrayingConfig:
    rate: float = 10.0

    def validate(self):
        pass


splatpilot.register_policy(StrayingConfig, lambda config, world, vehicle: Straying())
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a policy, found in the working directory."""
    package = tmp_path / "straying"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "speed.py").write_text("SPEED = 0.5\n")
    (package / "policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(POLICIES, "_entries", dict(POLICIES._entries))  # gone again for other tests
    return package


def test_a_study_is_flown_by_one_version_of_the_code_of_others(package, tmp_path, capsys):
    (tmp_path / "short.yaml").write_text(
        "world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}\n"
        "timeout: 0.4\n"
    )
    words = ["--import", "straying.policy", "benchmark", "--scenarios", "short.yaml", "--policies"]
    words += ["straying", "--seeds", "2", "--jobs", "1", "--out", "study"]
    assert main(words) == 0
    program = yaml.safe_load((tmp_path / "study/study.yaml").read_text())["program"]
    assert len(program["source of straying"]) == 16
    assert main(words) == 0  # nothing is missing

    (package / "speed.py").write_text("SPEED = 0.6\n")
    first, second = sorted((tmp_path / "study/rollouts").iterdir())
    first.unlink()
    capsys.readouterr()
    assert main(words) == 1
    assert "was started with source of straying" in capsys.readouterr().err
    row = second.stem
    # By the code that was imported: this process has what flew.
    assert main(["--import", "straying.policy", "replay", "study", row]) == 0

    second.unlink()
    assert main(words) == 0  # nothing is there that the other version flew
    told = yaml.safe_load((tmp_path / "study/study.yaml").read_text())["program"]
    assert told["source of straying"] != program["source of straying"]
    assert told.keys() == program.keys()


def test_our_own_code_is_the_program():
    assert foreign_code([Scenario()]) == {}
