"""`splatpilot difficulty`."""

import argparse


def add_to(verbs: argparse._SubParsersAction) -> None:
    difficulty = verbs.add_parser(
        "difficulty", help="print how hard scenarios are, and whether all seeds are feasible"
    )
    difficulty.set_defaults(verb=_difficulty)
    difficulty.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help="P01 to R17 or YAML files (default: all)"
    )
    difficulty.add_argument("--seeds", type=int, default=5, help="seeds of each (%(default)s)")


def _difficulty(options: argparse.Namespace) -> None:
    from splatpilot.analysis import difficulty

    difficulty.run(scenarios=options.scenarios, seeds=options.seeds)
