"""`splatpilot fidelity`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    fidelity = verbs.add_parser(
        "fidelity", help="measure how far from its capture's path a scene can be trusted"
    )
    fidelity.set_defaults(verb=_fidelity)
    fidelity.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="scene folder")
    fidelity.add_argument(
        "--out", type=Path, default=Path("out/fidelity"), help="output folder (%(default)s)"
    )
    add_overrides(fidelity, "max_depth_error=0.03")


def _fidelity(options: argparse.Namespace) -> None:
    from splatpilot.analysis.fidelity import run as fidelity
    from splatpilot.analysis.fidelity.config import FidelityConfig
    from splatpilot.systems.configuration import load_config

    config = load_config(FidelityConfig(), overrides=options.overrides)
    fidelity.run(options.scenes, options.out, config)
