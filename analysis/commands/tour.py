"""`splatpilot tour`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    tour = verbs.add_parser(
        "tour", help="from a mesh to a flight: render a capture, reconstruct it, fly in it"
    )
    tour.set_defaults(verb=_tour)
    tour.add_argument(
        "world", type=Path, help=".gltf or .obj, or a scenario of a generated world: P01 or a file"
    )
    tour.add_argument("--out", type=Path, required=True, help="folder for capture, scene, flight")
    tour.add_argument("--scene", type=Path, help="scene folder to write (default: OUT/scene)")
    tour.add_argument("--up", choices=("y", "z"), help="axis of the mesh file that points up")
    tour.add_argument("--seed", type=int, default=0, help="seed of a generated world")
    add_overrides(tour, "render.spacing=1")


def _tour(options: argparse.Namespace) -> None:
    from splatpilot.analysis import tour
    from splatpilot.systems.configuration import load_config

    logging.getLogger("drake").setLevel(logging.WARNING)
    config = tour.TourConfig()
    if options.up is not None:
        config.render.up = options.up
    config = load_config(config, overrides=options.overrides)
    tour.run(
        world=options.world,
        out=options.out,
        scene=options.scene,
        config=config,
        seed=options.seed,
    )
