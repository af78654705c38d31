"""`flysplat capture`: work on captures before they become scenes."""

import argparse
from pathlib import Path

from flysplat.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    capture = verbs.add_parser("capture", help="check a capture")
    actions = capture.add_subparsers(required=True, metavar="ACTION")
    _add_check(actions)


def _add_check(actions: argparse._SubParsersAction) -> None:
    check = actions.add_parser(
        "check",
        help="tell whether poses, intrinsics and depth of a capture agree",
        description="Carries depth from frame to frame and compares. Where it does not agree, "
        "tries the usual mistakes, names the most likely one, and ends with status 1.",
    )
    check.set_defaults(verb=_check)
    check.add_argument("capture", type=Path, help="folder of a capture")
    add_overrides(check, "capture.depth_unit=5000")


def _check(options: argparse.Namespace) -> None:
    from flysplat.diagrams.configuration import load_config
    from flysplat.training.captures import check

    config = load_config(check.CheckConfig(), overrides=options.overrides)
    check.run(capture=options.capture, config=config)
