"""What is flown: the options of the verbs that fly a scenario."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splatpilot.analysis.benchmark.variants import parse_variant
from splatpilot.analysis.commands.checks import (
    POLICIES,
    SCENARIOS,
    check_kind,
    check_policy,
    check_scenario,
)
from splatpilot.analysis.commands.overrides import add_overrides
from splatpilot.analysis.commands.verb import add_named
from splatpilot.systems.environment import require_scene

if TYPE_CHECKING:
    from splatpilot.diagrams.scenario import Scenario


def add_scenario(parser: argparse.ArgumentParser) -> None:
    """Adds the options that `read_scenario` reads."""
    add_named(
        parser,
        "--scenario",
        names=SCENARIOS,
        metavar="P02|FILE.yaml",
        help="the scenario to fly: the benchmark's, or a file",
    )
    add_named(
        parser,
        "--policy",
        names=POLICIES,
        metavar="NAME[:FIELD=VALUE]",
        help="who flies, as in the benchmark: planner, straight, reactive, diffaero, depthnav, "
        "agile_autonomy, ..., a file of weights, or module:Class",
    )
    parser.add_argument("--speed", type=float, metavar="M/S", help="nominal, of any policy")
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="DIR_OR_FILE",
        help="fly in this scene folder, file of Gaussians (PLY, SPZ, .splat; metres, z up) or "
        "OctoMap (.bt)",
    )
    parser.add_argument("--seed", type=int, help="seed of the world and the start")
    add_overrides(
        parser,
        ("timeout=20", "goal=[12,0,2]", "world.spacing=2.4", "policy.lattice.margin=0.2"),
        read_scenario,
    )


def check_scenario_options(options: argparse.Namespace) -> None:
    """
    Checks, before anything slow is imported, what the options name.

    Raises:
        OSError, ValueError: for what is not there.
    """
    if options.scenario is not None:
        check_scenario(options.scenario)
    if options.policy is not None:
        check_policy(parse_variant(options.policy))
    if options.scene is not None:
        check_kind(require_scene(str(options.scene)), "scene", "gaussians", "map")


def read_scenario(options: argparse.Namespace) -> "Scenario":
    """
    The scenario that the options name, with what they change of it.

    Raises:
        OSError, ValueError: for what is not there, or cannot be.
    """
    check_scenario_options(options)
    from splatpilot.diagrams.policies import DEFAULT_SPEED, at_speed
    from splatpilot.diagrams.scenario import Scenario
    from splatpilot.diagrams.scenario_files import scenario_file
    from splatpilot.diagrams.worlds.make_world import place_config
    from splatpilot.systems.configuration import load_config

    file = None if options.scenario is None else scenario_file(options.scenario)
    scenario = load_config(Scenario(), file)
    if options.policy is not None:
        scenario.policy = parse_variant(options.policy).config(DEFAULT_SPEED, scenario.policy)
    if options.speed is not None:
        scenario.policy = at_speed(scenario.policy, options.speed)
    if options.scene is not None:
        scenario.world = place_config(require_scene(str(options.scene)).absolute())
    if options.seed is not None:
        scenario.seed = options.seed
    return load_config(scenario, overrides=options.overrides)


def name_of_flight(options: argparse.Namespace, scenario: "Scenario") -> str:
    """What a flight is called, as in a study: after its scenario, or else its scene or its world,
    its policy, its speed and its seed."""
    from splatpilot.analysis.benchmark.study import flight_name
    from splatpilot.diagrams.policies import name_of, speed_of

    place = options.scene or options.scenario
    if place is None:
        place = type(scenario.world).__name__.removesuffix("Config").lower()
    variant = None if options.policy is None else parse_variant(options.policy)
    policy = name_of(scenario.policy) if variant is None else variant.label
    return flight_name(Path(place).stem, policy, speed_of(scenario.policy), scenario.seed)
