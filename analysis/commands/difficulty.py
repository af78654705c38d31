"""`splatpilot difficulty`."""

import argparse

from splatpilot.analysis.commands.options import SCENARIOS, add_named, add_verb, check_scenario
from splatpilot.systems.common.validation import require


def add_to(verbs: argparse._SubParsersAction) -> None:
    difficulty = add_verb(
        verbs,
        "difficulty",
        _difficulty,
        help="print how hard scenarios are, and whether all seeds are feasible",
        description="Measures worlds before anyone flies: how far obstacles force a flight off the "
        "straight line, how narrow and how cluttered its way is.",
        examples=("difficulty", "difficulty P06 P07 --seeds 10"),
    )
    add_named(
        difficulty,
        "scenarios",
        names=SCENARIOS,
        nargs="*",
        metavar="SCENARIO",
        help="P01 to R17 or YAML files (default: all)",
    )
    difficulty.add_argument("--seeds", type=int, default=5, help="seeds of each (%(default)s)")


def _difficulty(options: argparse.Namespace) -> None:
    for scenario in options.scenarios:
        check_scenario(scenario)
    require(options.seeds >= 1, "--seeds", "at least 1", options.seeds)
    from splatpilot.analysis import difficulty

    difficulty.run(scenarios=options.scenarios, seeds=options.seeds)
