"""`splatpilot reconstruct`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


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
    from splatpilot.analysis.reconstruction import measure_scene
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.captures.read_capture import read_capture
    from splatpilot.training.reconstruction import reconstruct
    from splatpilot.training.reconstruction.config import ReconstructConfig

    config = load_config(ReconstructConfig(), overrides=options.overrides)
    if options.iterations is not None:
        config.iterations = options.iterations
    reconstruct.run(
        capture=options.capture, out=options.out, config=config, restart=options.restart
    )
    measure_scene.run(options.out, read_capture(options.capture, config.capture))
