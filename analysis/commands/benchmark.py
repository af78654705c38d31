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
        "--policies", type=_names, metavar="A,B.npz", help="names or files of weights; default: all"
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
    add_overrides(benchmark, "observation.depth_multiplicative=0.03")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _benchmark(options: argparse.Namespace) -> None:
    from splatpilot.analysis.benchmark import run as benchmark
    from splatpilot.analysis.benchmark.study import StudyConfig

    logging.getLogger("drake").setLevel(logging.WARNING)
    config = StudyConfig(overrides=options.overrides)
    if options.quick:
        config.scenarios, config.policies = list(QUICK_SCENARIOS), list(QUICK_POLICIES)
        config.seeds = QUICK_SEEDS
    for name in ("policies", "scenarios", "seeds"):
        value = getattr(options, name)
        if value is not None:
            setattr(config, name, value)
    if options.speeds is not None:
        config.speeds = [_speed(text) for text in options.speeds]
    benchmark.run(config=config, out=options.out, jobs=options.jobs, cluster=options.cluster)


def _speed(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"the speed {text!r} is no number; give metres per second") from None
