"""The command line. It stands on the top floor because it may reach every other."""

import argparse
import logging
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """
    Runs `flysplat VERB ...`.

    Args:
        arguments: the words after `flysplat`; those of the process when None.

    Returns:
        The exit status: 0, or 1 after an error that one message on standard error explains.
    """
    options = _parser().parse_args(arguments)
    try:
        options.verb(options)
    except (ValueError, OSError) as error:
        print(f"flysplat: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("flysplat: interrupted", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="flysplat", description="Fly drones by camera inside Gaussian-splat worlds."
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    fly = verbs.add_parser("fly", help="fly to a goal and leave a page, a video and a trajectory")
    fly.set_defaults(verb=_fly)
    fly.add_argument("--scenario", type=Path, metavar="FILE.yaml", help="the scenario to fly")
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
    _add_overrides(fly, "policy.lattice.speed=3")

    reconstruct = verbs.add_parser("reconstruct", help="make a scene to fly in from a capture")
    reconstruct.set_defaults(verb=_reconstruct)
    reconstruct.add_argument("capture", type=Path, help="folder of a TartanAir V1 sequence")
    reconstruct.add_argument("--out", type=Path, required=True, help="scene folder to write")
    reconstruct.add_argument("--iterations", type=int, help="optimisation steps")
    _add_overrides(reconstruct, "voxel_size=0.1")
    return parser


def _add_overrides(parser: argparse.ArgumentParser, example: str) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="FIELD=VALUE",
        help=f"override one field of the configuration, for example {example} (repeatable)",
    )


# Each verb imports what it needs when it runs: torch and pydrake take seconds to load.


def _fly(options: argparse.Namespace) -> None:
    from flysplat.diagrams import fly
    from flysplat.diagrams.configuration import load_config
    from flysplat.diagrams.scenario import Scenario
    from flysplat.diagrams.worlds.make_world import SceneConfig

    logging.getLogger("drake").setLevel(logging.WARNING)
    scenario = load_config(Scenario(), options.scenario)
    if options.scene is not None:
        scenario.world = SceneConfig(path=str(options.scene.absolute()))
    if options.seed is not None:
        scenario.seed = options.seed
    scenario = load_config(scenario, overrides=options.overrides)
    fly.run(scenario=scenario, out=options.out, live=options.live, graphviz=options.graphviz)


def _reconstruct(options: argparse.Namespace) -> None:
    from flysplat.diagrams.configuration import load_config
    from flysplat.training import reconstruct

    config = load_config(reconstruct.ReconstructConfig(), overrides=options.overrides)
    if options.iterations is not None:
        config.iterations = options.iterations
    reconstruct.run(capture=options.capture, out=options.out, config=config)
