"""`splatpilot ablate`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    ablate = verbs.add_parser(
        "ablate", help="reconstruct captures with and without depth, as 3DGS and 2DGS, and compare"
    )
    ablate.set_defaults(verb=_ablate)
    ablate.add_argument(
        "captures", type=Path, nargs="+", metavar="CAPTURE", help="folder of a capture, or a scene"
    )
    ablate.add_argument(
        "--out", type=Path, default=Path("out/ablation"), help="output folder (%(default)s)"
    )
    add_overrides(ablate, "iterations=3000")


def _ablate(options: argparse.Namespace) -> None:
    from splatpilot.analysis.reconstruction import ablation
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.reconstruction.config import ReconstructConfig

    config = load_config(ReconstructConfig(), overrides=options.overrides)
    ablation.run(options.captures, options.out, config)
