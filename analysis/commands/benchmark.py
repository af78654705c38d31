"""`splatpilot benchmark`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides

QUICK_SCENARIOS = "P02", "P06", "P08"
QUICK_POLICIES = "planner", "straight", "reactive"
QUICK_SEEDS = 5


def add_to(verbs: argparse._SubParsersAction) -> None:
    benchmark = verbs.add_parser(
        "benchmark",
        help="fly policies through scenarios, many times, and report",
        description="Flies scenarios x policies x speeds x seeds, and leaves rollouts.csv, "
        "table.csv and report.html. Run again, it flies what is missing.",
    )
    benchmark.set_defaults(verb=_benchmark)
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
    benchmark.add_argument("--jobs", type=int, metavar="N", help="worker processes; default: cores")
    benchmark.add_argument(
        "--cluster", metavar="ADDRESS", help="fly on the workers of this dask scheduler instead"
    )
    benchmark.add_argument(
        "--shard",
        metavar="I/N",
        help="fly the I-th of N parts, in a folder of its own; `splatpilot merge` joins them",
    )
    add_overrides(benchmark, "observation.depth_multiplicative=0.03")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _benchmark(options: argparse.Namespace) -> None:
    from splatpilot.analysis.benchmark import run as benchmark
    from splatpilot.analysis.benchmark.external import DODGEDRONE, DODGEDRONE_SPEEDS
    from splatpilot.analysis.benchmark.shard import Shard
    from splatpilot.analysis.benchmark.study import StudyConfig, default_policies
    from splatpilot.analysis.benchmark.variants import split_policies, sweep

    logging.getLogger("drake").setLevel(logging.WARNING)
    config = StudyConfig(overrides=options.overrides)
    if options.quick:
        config.scenarios, config.policies = list(QUICK_SCENARIOS), list(QUICK_POLICIES)
        config.seeds = QUICK_SEEDS
    if options.dodgedrone:
        config.scenarios, config.speeds = list(DODGEDRONE), list(DODGEDRONE_SPEEDS)
    for name in ("scenarios", "seeds"):
        value = getattr(options, name)
        if value is not None:
            setattr(config, name, value)
    if options.policies is not None or options.sweep:
        swept = [variant for text in options.sweep for variant in sweep(text)]
        config.policies = [*split_policies(options.policies or ""), *swept]
    elif not options.quick:
        config.policies = default_policies(config.scenarios)
    if options.speeds is not None:
        config.speeds = [_speed(text) for text in options.speeds]
    benchmark.run(
        config=config,
        out=options.out,
        jobs=options.jobs,
        cluster=options.cluster,
        shard=None if options.shard is None else Shard.parse(options.shard),
    )


def _speed(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"the speed {text!r} is no number; give metres per second") from None
