"""`splatpilot faults`."""

import argparse
import logging
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_verb, check_config


def add_to(verbs: argparse._SubParsersAction) -> None:
    faults = add_verb(
        verbs,
        "faults",
        _faults,
        help="fly while messages, clocks and policies fail",
        description="Flies hundreds of short flights through the bridge while messages are lost, "
        "late or false, clocks jump or policies fail, and counts which ended safely. Interrupted, "
        "the same command goes on.",
        examples=("faults --set trials=30", "faults --out out/faults_1 --set seed=1"),
    )
    faults.add_argument(
        "--out", type=Path, default=Path("out/faults"), help="output folder (%(default)s)"
    )
    faults.add_argument("--config", type=Path, help="YAML file with fields of the configuration")
    add_overrides(faults, ("trials=30", "seed=1", "scenario.timeout=20"), _defaults)


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.faults.campaign import FaultsConfig

    return FaultsConfig()


def _faults(options: argparse.Namespace) -> None:
    check_config(options.config)
    from splatpilot.analysis.faults.campaign import run
    from splatpilot.systems.common.config import load_config

    config = load_config(_defaults(options), options.config, options.overrides)
    # Thousands of packets are refused, and policies raise, on purpose.
    loggers = [logging.getLogger(name) for name in ("drake", "splatpilot")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        run(config=config, out=options.out)
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
