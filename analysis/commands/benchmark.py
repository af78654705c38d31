"""`splatpilot benchmark`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.variants import parse_variant, split_policies, sweep
from splatpilot.analysis.commands.options import (
    FailureWithResultError,
    add_json,
    add_overrides,
    add_verb,
    check_policy,
    check_scenario,
)

QUICK_SCENARIOS = "P02", "P06", "P08"
QUICK_POLICIES = "planner", "straight", "reactive"
QUICK_SEEDS = 5


def add_to(verbs: argparse._SubParsersAction) -> None:
    benchmark = add_verb(
        verbs,
        "benchmark",
        _benchmark,
        help="fly policies through scenarios, many times, and report",
        description="Flies scenarios x policies x speeds x seeds, and leaves rollouts.csv, "
        "table.csv and report.html. Run again, it flies what is missing. Ends with status 1 if no "
        "flight could be flown.",
        examples=(
            "benchmark --out out/quick --quick",
            "benchmark --out out/study --scenarios P02,P03 --policies planner,reactive:margin=0.2",
            "benchmark --out out/mine --policies mine=out/forests/diffaero.npz --speeds 2,3 --json",
        ),
    )
    benchmark.add_argument("--out", type=Path, required=True, help="folder of the study")
    benchmark.add_argument(
        "--quick",
        action="store_true",
        help=f"a few minutes: {', '.join(QUICK_SCENARIOS)}, {', '.join(QUICK_POLICIES)}, "
        f"{QUICK_SEEDS} seeds, unless other ones are named",
    )
    benchmark.add_argument(
        "--dodgedrone",
        action="store_true",
        help="the DodgeDrone challenge, easy, medium and hard, at 2, 3, 5 and 7 m/s, beside "
        "published figures, unless other scenarios and speeds are named",
    )
    benchmark.add_argument(
        "--policies",
        metavar="A,B.npz,C:FIELD=VALUE,...",
        help="names, files of weights or module:Class, with LABEL= before and fields behind; "
        "scenario: each scenario's own; default: that, where all have one, or else all",
    )
    benchmark.add_argument(
        "--sweep",
        action="append",
        default=[],
        metavar="A:FIELD=1,2,3",
        help="a policy with each of these values of a field, and all combinations of the values "
        "of several (repeatable)",
    )
    benchmark.add_argument(
        "--scenarios", type=_names, metavar="P02,FILE.yaml", help="default: all of the benchmark"
    )
    benchmark.add_argument("--speeds", type=_names, metavar="2,3", help="nominal, m/s; default: 2")
    benchmark.add_argument("--seeds", type=int, metavar="N", help="flights of each; default: 20")
    benchmark.add_argument(
        "--split",
        help="whose seeds: dev (default), to develop by, or test, to report what is final",
    )
    benchmark.add_argument("--jobs", type=int, metavar="N", help="worker processes; default: cores")
    benchmark.add_argument(
        "--cluster", metavar="ADDRESS", help="fly on the workers of this dask scheduler instead"
    )
    add_overrides(
        benchmark, ("observation.depth_multiplicative=0.03", "timeout=90"), _scenario_defaults
    )
    add_json(benchmark, "the rows of table.csv")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _scenario_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.diagrams.flight.scenario import Scenario

    return Scenario()


def _benchmark(options: argparse.Namespace) -> Any:
    for scenario in options.scenarios or ():
        check_scenario(scenario)
    named = None
    if options.policies is not None or options.sweep:
        swept = [variant for text in options.sweep for variant in sweep(text)]
        named = [*split_policies(options.policies or ""), *swept]
        for policy in named:
            check_policy(parse_variant(policy))
    from splatpilot.systems.common.progress import say

    say(f"flying a study in {options.out}")
    from splatpilot.analysis.benchmark import run_study as benchmark
    from splatpilot.analysis.benchmark.external import DODGEDRONE, DODGEDRONE_SPEEDS
    from splatpilot.analysis.benchmark.study import StudyConfig, default_policies

    config = StudyConfig(overrides=options.overrides)
    if options.quick:
        config.scenarios, config.policies = list(QUICK_SCENARIOS), list(QUICK_POLICIES)
        config.seeds = QUICK_SEEDS
    if options.dodgedrone:
        config.scenarios, config.speeds = list(DODGEDRONE), list(DODGEDRONE_SPEEDS)
    for name in ("scenarios", "seeds", "split"):
        value = getattr(options, name)
        if value is not None:
            setattr(config, name, value)
    if named is not None:
        config.policies = named
    elif not options.quick:
        config.policies = default_policies(config.scenarios)
    if options.speeds is not None:
        config.speeds = [_speed(text) for text in options.speeds]
    table = benchmark.run(
        config=config,
        out=options.out,
        jobs=options.jobs,
        cluster=options.cluster,
    )
    require_flown(table)
    return table


def require_flown(table: list[dict[str, Any]]) -> None:
    """
    Raises:
        FailureWithResultError: if a study has flights, and none of them could be flown.
    """
    if table and all(row["infeasible"] == row["flights"] for row in table):
        raise FailureWithResultError(
            "none of the flights could be flown; rollouts.csv has the reasons", table
        )


def _speed(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--speeds must be numbers in m/s, got {text!r}") from None
