"""`splatpilot fly`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    fly = verbs.add_parser("fly", help="fly to a goal and leave a page, a video and a trajectory")
    fly.set_defaults(verb=_fly)
    fly.add_argument(
        "--scenario",
        metavar="P02|FILE.yaml",
        help="the scenario to fly: the benchmark's, or a file",
    )
    fly.add_argument(
        "--policy",
        metavar="NAME",
        help="who flies, by its name in the benchmark, or a file of weights",
    )
    fly.add_argument(
        "--scene",
        type=Path,
        metavar="DIR_OR_PLY",
        help="fly in this scene folder, or PLY in metres, z up",
    )
    fly.add_argument("--seed", type=int, help="seed of the world and the start")
    fly.add_argument(
        "--out", type=Path, default=Path("out/fly"), help="output folder (%(default)s)"
    )
    fly.add_argument("--live", action="store_true", help="serve Meshcat while flying, in real time")
    fly.add_argument("--graphviz", type=Path, metavar="FILE", help="write the diagram as Graphviz")
    add_overrides(fly, "policy.lattice.speed=3")


def _fly(options: argparse.Namespace) -> None:
    from splatpilot.diagrams import fly
    from splatpilot.diagrams.policies import policy_named
    from splatpilot.diagrams.scenario import Scenario
    from splatpilot.diagrams.scenario_files import scenario_file
    from splatpilot.diagrams.worlds.make_world import SceneConfig
    from splatpilot.systems.configuration import load_config

    logging.getLogger("drake").setLevel(logging.WARNING)
    file = None if options.scenario is None else scenario_file(options.scenario)
    scenario = load_config(Scenario(), file)
    if options.policy is not None:
        scenario.policy = policy_named(options.policy)
    if options.scene is not None:
        scenario.world = SceneConfig(path=str(options.scene.absolute()))
    if options.seed is not None:
        scenario.seed = options.seed
    scenario = load_config(scenario, overrides=options.overrides)
    fly.run(scenario=scenario, out=options.out, live=options.live, graphviz=options.graphviz)
