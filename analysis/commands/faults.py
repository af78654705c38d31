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

    config = load_config(FaultsConfig(), options.config, options.overrides)
    # Thousands of packets are refused on purpose.
    loggers = [logging.getLogger(name) for name in ("drake", "splatpilot")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        run(config=config, out=options.out)
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
