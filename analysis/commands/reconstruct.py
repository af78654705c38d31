"""`splatpilot reconstruct`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_overwrite, add_verb, find_place


def add_to(verbs: argparse._SubParsersAction) -> None:
    reconstruct = add_verb(
        verbs,
        "reconstruct",
        _reconstruct,
        help="make a scene to fly in from a capture",
        description="Fits Gaussians to the images and depth of a capture, measures them on frames "
        "that were held out, and leaves a scene folder with its distance field. Interrupted, the "
        "same command goes on.",
        examples=(
            "reconstruct data/hospital --out scenes/hospital",
            "reconstruct data/office --out scenes/office --set representation=2dgs",
            "reconstruct photos --out scenes/room --set capture.scale.camera_height=1.5",
        ),
    )
    reconstruct.add_argument("capture", type=Path, help="folder of the capture")
    reconstruct.add_argument("--out", type=Path, required=True, help="scene folder to write")
    reconstruct.add_argument("--iterations", type=int, help="optimisation steps")
    reconstruct.add_argument(
        "--restart", action="store_true", help="discard what an interrupted run has left"
    )
    add_overwrite(reconstruct)
    add_overrides(
        reconstruct,
        ("voxel_size=0.1", "image_width=640", "max_gaussians=200000", "device=cuda"),
        reconstruction_defaults,
    )


def _reconstruct(options: argparse.Namespace) -> None:
    options.capture = find_place(options.capture, "capture")
    from splatpilot.systems.common.progress import say

    say(f"reconstructing {options.capture} as {options.out}")
    from splatpilot.analysis.reconstruction import run as reconstruction
    from splatpilot.systems.common.config import load_config

    overrides = list(options.overrides)
    if options.iterations is not None:
        if any(override.startswith("iterations=") for override in overrides):
            raise ValueError("iterations are given by --iterations and by --set; keep one of them")
        overrides.append(f"iterations={options.iterations}")
    config = load_config(reconstruction_defaults(), overrides=overrides)
    reconstruction.run(
        capture=options.capture,
        out=options.out,
        config=config,
        restart=options.restart,
        overwrite=options.overwrite,
    )


def reconstruction_defaults(options: argparse.Namespace | None = None) -> Any:
    """The configuration of a reconstruction, which `--set` changes."""
    from splatpilot.training.reconstruction.config import ReconstructConfig

    return ReconstructConfig()
