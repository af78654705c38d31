"""What is flown: the options of the verbs that fly a scenario."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splatpilot.analysis.commands.overrides import add_overrides

if TYPE_CHECKING:
    from splatpilot.diagrams.scenario import Scenario


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """Adds the options that `read_scenario` reads."""
    parser.add_argument(
        "--scenario",
        metavar="P02|FILE.yaml",
        help="the scenario to fly: the benchmark's, or a file",
    )
    parser.add_argument(
        "--policy",
        metavar="NAME",
        help="who flies, by its name in the benchmark, or a file of weights",
    )
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR_OR_PLY",
        help="fly in this scene folder, or PLY in metres, z up",
    )
    parser.add_argument("--seed", type=int, help="seed of the world and the start")
    add_overrides(parser, "policy.lattice.speed=3")


def read_scenario(options: argparse.Namespace) -> "Scenario":
    """
    The scenario that the options name, with what they change of it.

    Raises:
        OSError, ValueError: for what is not there, or cannot be.
    """
    from splatpilot.diagrams.policies import policy_named
    from splatpilot.diagrams.scenario import Scenario
    from splatpilot.diagrams.scenario_files import scenario_file
    from splatpilot.diagrams.worlds.make_world import SceneConfig
    from splatpilot.systems.configuration import load_config

    file = None if options.scenario is None else scenario_file(options.scenario)
    scenario = load_config(Scenario(), file)
    if options.policy is not None:
        scenario.policy = policy_named(options.policy)
    if options.scene is not None:
        scenario.world = SceneConfig(path=str(options.scene.absolute()))
    if options.seed is not None:
        scenario.seed = options.seed
    return load_config(scenario, overrides=options.overrides)
