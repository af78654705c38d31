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
    from splatpilot.analysis.reconstruction import run as reconstruction
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    overrides = list(options.overrides)
    if options.iterations is not None:
        if any(override.startswith("iterations=") for override in overrides):
            raise ValueError("iterations are given by --iterations and by --set; keep one of them")
        overrides.append(f"iterations={options.iterations}")
    config = load_config(ReconstructConfig(), overrides=overrides)
    reconstruction.run(
        capture=options.capture, out=options.out, config=config, restart=options.restart
    )
