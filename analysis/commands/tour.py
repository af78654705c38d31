"""`splatpilot tour`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_verb, find_place


def add_to(verbs: argparse._SubParsersAction) -> None:
    tour = add_verb(
        verbs,
        "tour",
        _tour,
        help="from a mesh to a flight: render a capture, reconstruct it, fly in it",
        description="Renders a capture of a mesh or of a generated world, reconstructs it, and "
        "flies in what came of it. Interrupted, the same command goes on; a flight that is there "
        "is flown again.",
        examples=(
            "tour warehouse.gltf --up z --out out/warehouse",
            "tour P09 --out out/alley --set reconstruct.iterations=500",
        ),
    )
    tour.add_argument(
        "world",
        type=Path,
        help=".glb, .gltf or .obj, or a scenario of a generated world: P01 or a file",
    )
    tour.add_argument("--out", type=Path, required=True, help="folder for capture, scene, flight")
    tour.add_argument("--scene", type=Path, help="scene folder to write (default: OUT/scene)")
    tour.add_argument("--up", choices=("y", "z"), help="axis of the mesh file that points up")
    tour.add_argument("--seed", type=int, default=0, help="seed of a generated world")
    add_overrides(
        tour, ("render.spacing=1", "reconstruct.iterations=3000", "flight.timeout=90"), _defaults
    )


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.tour import TourConfig

    return TourConfig()


def _tour(options: argparse.Namespace) -> None:
    options.world = find_place(options.world, "mesh", "scenario")
    from splatpilot.analysis import tour
    from splatpilot.systems.common.config import load_config

    config = _defaults(options)
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
