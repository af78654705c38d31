"""`splatpilot faults`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    faults = verbs.add_parser("faults", help="fly while messages, clocks and policies fail")
    faults.set_defaults(verb=_faults)
    faults.add_argument(
        "--out", type=Path, default=Path("out/faults"), help="output folder (%(default)s)"
    )
    faults.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(faults, "trials=30")


def _faults(options: argparse.Namespace) -> None:
    from splatpilot.analysis.faults.run import FaultsConfig, run
    from splatpilot.systems.configuration import load_config

    for name in ("drake", "splatpilot"):
        logging.getLogger(name).setLevel(logging.ERROR)
    run(config=load_config(FaultsConfig(), options.config, options.overrides), out=options.out)
