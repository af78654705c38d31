"""`splatpilot fly` and `splatpilot view`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.variants import flight_name, parse_variant
from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.checks import SCENARIOS
from splatpilot.diagrams.scenarios import scenario_file


def _names(text: str) -> list[str]:
    return text.split(",")


@cli.command(
    "fly",
    *cli.SCENARIO_OPTIONS,
    cli.out_option(
        "output folder (default: out/SCENARIO-POLICY-SPEED-SEED)", required=False, unused=True
    ),
    cli.OVERWRITE,
    cli.flag("--live", "serve Meshcat during the flight, with buttons to pause, step and restart"),
    cli.Option(
        "--draw NAMES",
        "with --live, draw some of velocity,thrust,rates,waypoint,nearest,barrier,axes,depth,"
        "frustum,limits",
        _names,
        default=[],
    ),
    cli.flag("--no-video", "do not write flight.mp4"),
    cli.Option("--rerun FILE", "record the flight for the viewer Rerun (.rrd)", Path, unused=True),
    cli.Option("--graphviz FILE", "write the diagram as Graphviz (.dot)", Path, unused=True),
    cli.json_option("the summary"),
    examples=(
        "fly --scenario P02 --policy diffaero --speed 3",
        "fly --policy teleop --live --draw thrust,nearest",
        "fly --scene scenes/hospital --policy reactive:margin=0.2 --no-video --json",
    ),
)
def fly(options: argparse.Namespace) -> Any:
    """Flies one scenario, by default a forest. Writes a page to watch the flight, the onboard
    video, the trajectory, its summary, and the scenario with all fields."""
    scenario = cli.read_scenario(options)
    out = options.out or Path("out") / _flight_name(options, scenario)
    from splatpilot.diagrams.flight import fly

    summary = cli.call(fly.run, options, scenario=scenario, out=out, video=not options.no_video)
    if "reason" in summary:
        raise cli.FailureWithResultError(f"the flight ended {summary['reason']}", summary)
    return summary


def _flight_name(options: argparse.Namespace, scenario: Any) -> str:
    """Names a flight by its scenario, scene or world, policy, speed and seed, as studies do."""
    from splatpilot.diagrams.flight.policies import policy_name, policy_speed

    world = options.scene or options.scenario
    if world is None:
        world = type(scenario.world).__name__.removesuffix("Config").lower()
    policy = parse_variant(options.policy).label if options.policy else policy_name(scenario.policy)
    return flight_name(Path(world).stem, policy, policy_speed(scenario.policy), scenario.seed)


def _scenario_defaults(options: argparse.Namespace) -> Any:
    """Returns the scenario that is viewed, or the default one."""
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import load_config

    return load_config(
        Scenario(), scenario_file(options.what) if options.what in SCENARIOS else None
    )


WORLD_FIELDS = cli.set_option(
    "world.spacing=2.4", "world.height=8", configuration=_scenario_defaults
)


@cli.command(
    "view",
    cli.input_option("what", "scene", "gaussians", "map", "capture", "scenario"),
    cli.out_option("page to write (default: out/view/NAME.html)", required=False, unused=True),
    cli.SEED,
    cli.OVERWRITE,
    WORLD_FIELDS,
    examples=("view scenes/hospital", "view P02 --seed 3 --set world.spacing=2.4"),
)
def view(options: argparse.Namespace) -> None:
    """Writes a page that any browser opens, without a server or a network: the Gaussians, distances
    to surfaces, captured images at their poses, a ruler."""
    from splatpilot.analysis import view

    cli.call(view.run, options)
