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
    """The configuration of the world of a scenario: the benchmark's, or a file.

    Raises:
        FileNotFoundError, ValueError: if there is no such scenario.
    """
    return load_config(Scenario(), scenario_file(kind)).world
