"""The kinds of generated worlds that policies train in: the benchmark's, of seeds it never uses."""

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios, scenario_file
from splatpilot.diagrams.worlds.make_world import WorldConfig
from splatpilot.systems.configuration import load_config

PROCEDURAL = tuple(name for name in benchmark_scenarios() if name.startswith("P"))
"""The scenarios whose worlds are made from seeds."""

ROUNDABOUT = ("P06", "P07", "P08", "P09", "P10", "P12")
"""Those of them whose ways are far from straight: learned slowest, so trained in twice as often."""


def world_of(kind: str) -> WorldConfig:
    """The configuration of a scenario's world."""
    return load_config(Scenario(), scenario_file(kind)).world


def check_kinds(kinds: list[str]) -> None:
    """Raises ValueError for what is no kind of generated world, and for none at all."""
    unknown = [kind for kind in kinds if kind not in PROCEDURAL]
    if unknown or not kinds:
        raise ValueError(f"worlds.kinds is {kinds}; choose from {', '.join(PROCEDURAL)}")
