"""`flysplat reconstruct`."""

import argparse
from pathlib import Path

from flysplat.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    reconstruct = verbs.add_parser("reconstruct", help="make a scene to fly in from a capture")
    reconstruct.set_defaults(verb=_reconstruct)
    reconstruct.add_argument("capture", type=Path, help="folder of the capture")
    reconstruct.add_argument("--out", type=Path, required=True, help="scene folder to write")
    reconstruct.add_argument("--iterations", type=int, help="optimisation steps")
    reconstruct.add_argument(
        "--restart", action="store_true", help="discard what an interrupted run has left"
    )
    add_overrides(reconstruct, "voxel_size=0.1")


def _reconstruct(options: argparse.Namespace) -> None:
    from flysplat.analysis import measure_scene
    from flysplat.diagrams.configuration import load_config
    from flysplat.training import reconstruct
    from flysplat.training.captures.read_capture import read_capture
    from flysplat.training.reconstruct_config import ReconstructConfig

    config = load_config(ReconstructConfig(), overrides=options.overrides)
    if options.iterations is not None:
        config.iterations = options.iterations
    reconstruct.run(
        capture=options.capture, out=options.out, config=config, restart=options.restart
    )
    measure_scene.run(options.out, read_capture(options.capture, config.capture))
