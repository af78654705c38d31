"""`splatpilot fly`, `view` and `hardware`."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.variants import flight_name, parse_variant
from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.checks import SCENARIOS
from splatpilot.diagrams.scenarios import scenario_file


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
        lambda text: text.split(","),
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
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import load_config

    file = scenario_file(options.what) if options.what in SCENARIOS else None
    return load_config(Scenario(), file)


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


_LCM_URL = cli.Option("--lcm-url URL", "LCM's multicast group and port")
_MESSAGING = (
    cli.path_option("--hardware FILE", "a YAML file of a HardwareConfig"),
    _LCM_URL,
    cli.Option("--patience S", "maximum wait for messages [s]", float),
    cli.OVERWRITE,
    *cli.SCENARIO_OPTIONS,
)


def _hardware_config(options: argparse.Namespace) -> Any:
    from splatpilot.diagrams.hardware.bridge import HardwareConfig
    from splatpilot.systems.common.config import load_config

    given = {"url": options.lcm_url, "patience": options.patience}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(load_config(HardwareConfig(), options.hardware), **given)


@cli.command(
    "hardware vehicle",
    cli.out_option("output folder", "out/vehicle", unused=True),
    *_MESSAGING,
    examples=("hardware vehicle --scenario P02 --seed 3 --patience 60 --out out/vehicle_3",),
)
def vehicle(options: argparse.Namespace) -> None:
    """Hovers at the scenario's start until it receives commands, and follows them in real time.
    `splatpilot hardware bridge` flies it instead of a real vehicle."""
    scenario = cli.read_scenario(options)
    from splatpilot.diagrams.hardware import vehicle

    cli.call(vehicle.run, options, scenario=scenario, config=_hardware_config(options))


@cli.command(
    "hardware bridge",
    cli.Option("--log", "write all messages to this file, as lcm-logger does", Path, unused=True),
    *_MESSAGING,
    examples=("hardware bridge --scenario P02 --hardware hardware.yaml --log flight.lcm",),
)
def bridge(options: argparse.Namespace) -> None:
    """Runs policy, controller and failsafe for a vehicle that sends its state and its images, and
    follows commands."""
    scenario = cli.read_scenario(options)
    from splatpilot.diagrams.hardware import bridge

    cli.call(bridge.run, options, scenario=scenario, config=_hardware_config(options))


@cli.command(
    "hardware px4",
    cli.CONFIG,
    _LCM_URL,
    cli.flag("--engage", "request offboard mode"),
    cli.flag("--arm", "arm the motors, in offboard mode"),
    cli.path_option("--replay LOG.ulg", "replay a log of PX4 instead, and report on it"),
    cli.set_option(
        *("udp.host=0.0.0.0", "vehicle_host=192.168.8.1", "'udp.senders=[192.168.8.1]'"),
        configuration="splatpilot.diagrams.hardware.px4:Px4Config",
    ),
    examples=(
        "hardware px4 --set vehicle_host=192.168.8.1 --set udp.host=0.0.0.0 --set "
        "'udp.senders=[192.168.8.1]'",
        "hardware px4 --config px4.yaml --engage",
        "hardware px4 --replay flight.ulg",
    ),
)
def px4(options: argparse.Namespace) -> None:
    """Sends the estimate of PX4 to the bridge, and its commands to PX4. Arms only with --arm."""
    from splatpilot.diagrams.hardware import px4

    config = cli.read_config(options)
    if options.lcm_url is not None:
        config.url = options.lcm_url
    config.commander.engage |= options.engage
    config.commander.arm |= options.arm
    px4.run(config=config, log=options.replay)


@cli.command(
    "hardware faults",
    cli.out_option("output folder", "out/faults"),
    cli.CONFIG,
    cli.JOBS,
    cli.set_option(
        *("trials=30", "seed=1", "scenario.timeout=20"),
        configuration="splatpilot.analysis.faults:FaultsConfig",
    ),
    examples=("hardware faults --out out/faults_1 --set seed=1",),
)
def faults(options: argparse.Namespace) -> None:
    """Flies hundreds of short flights through the bridge with lost, late or false messages, clock
    jumps or failing policies, and counts those that end safely. If interrupted, the same command
    resumes."""
    from splatpilot.analysis.faults import run

    run(config=cli.read_config(options), out=options.out, jobs=options.jobs)
