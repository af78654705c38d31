"""`splatpilot benchmark`, `replay` and `difficulty`."""

import argparse
from itertools import product
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.variants import (
    BENCHMARK_POLICIES,
    scenario_sweep,
    split_policies,
    sweep,
)
from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.checks import (
    SCENARIOS,
    check_policy,
    check_scenario,
    check_study_scenario,
)
from splatpilot.systems.common.validation import require

QUICK = {
    "scenarios": ["P02", "P06", "P08"],
    "policies": ["planner", "straight", "reactive"],
    "seeds": 5,
}
"""The study of `--quick`."""


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _check_sweep(text: str) -> str:
    if scenario_sweep(text) is None:
        for policy in sweep(text):
            check_policy(policy)
    return text


def _speed(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--speeds must be numbers in m/s, got {text!r}") from None


@cli.command(
    "benchmark",
    cli.out_option("folder of the study"),
    cli.flag(
        "--quick",
        f"a study of a few minutes: {', '.join(QUICK['scenarios'])}, "
        f"{', '.join(QUICK['policies'])}, {QUICK['seeds']} seeds, unless others are given",
    ),
    cli.flag(
        "--dodgedrone",
        "the DodgeDrone challenge, easy, medium and hard, at 2, 3, 5 and 7 m/s, next to published "
        "results, unless other scenarios and speeds are given",
    ),
    cli.Option(
        "--policies A,B.npz,C:FIELD=VALUE,...",
        "names, files of weights or module:Class, with LABEL= before and fields after; "
        "'scenario' is each scenario's own policy, the default if all have one; otherwise the "
        f"default is {', '.join(BENCHMARK_POLICIES)}",
        split_policies,
        resolve=check_policy,
    ),
    cli.Option(
        "--sweep [A:]FIELD=1,2,3",
        "fly policy A, or without A all scenarios, with each of these values of a field "
        "(repeatable); several fields of scenarios, or A:FIELD=1,2:FIELD=3,4, fly all combinations",
        action="append",
        default=[],
        resolve=_check_sweep,
    ),
    cli.Option(
        "--scenarios P02,FILE.yaml:FIELD=VALUE,...",
        "names or files, with LABEL= before and fields after; default: all",
        split_policies,
        resolve=check_study_scenario,
    ),
    cli.Option(
        "--speeds 2,3",
        "nominal speeds [m/s]; default: 2, or that of the scenarios' own policy",
        _names,
        resolve=_speed,
    ),
    cli.Option("--seeds N", "flights of each policy, scenario and speed; default: 20", int),
    cli.Option("--split", "seeds to fly: dev (default) for development, test for final results"),
    cli.JOBS,
    cli.Option("--cluster ADDRESS", "fly on the workers of this dask scheduler"),
    cli.set_option(
        *("observation.depth_multiplicative=0.03", "timeout=90"),
        configuration="splatpilot.diagrams.flight.scenario:Scenario",
    ),
    cli.json_option("the rows of table.csv"),
    examples=(
        "benchmark --out out/quick --quick",
        "benchmark --out out/study --scenarios P02,P03 --policies planner,reactive:margin=0.2",
        "benchmark --out out/drag --scenarios P02 --policies planner --sweep vehicle.drag=0.3,0.5",
        "benchmark --out out/mine --policies mine=out/forests/diffaero.npz --speeds 2,3 --json",
    ),
)
def benchmark(options: argparse.Namespace) -> Any:
    """Flies scenarios x policies x speeds x seeds, and writes rollouts.csv, table.csv and
    report.html. The same command resumes an interrupted study. Exits with status 1 if no flight
    could be flown."""
    cli.announce(f"flying a study in {options.out}")
    from splatpilot.analysis.benchmark import run_study
    from splatpilot.analysis.benchmark.study import StudyConfig, default_policies, own_speeds
    from splatpilot.analysis.benchmark.tables import DODGEDRONE_SPEEDS, PUBLISHED

    fields: dict[str, Any] = {"overrides": options.overrides}
    if options.quick:
        fields |= QUICK
    if options.dodgedrone:
        fields |= {"scenarios": list(PUBLISHED), "speeds": list(DODGEDRONE_SPEEDS)}
    named = {name: getattr(options, name) for name in ("scenarios", "seeds", "split", "speeds")}
    fields |= {name: value for name, value in named.items() if value is not None}
    swept = [values for text in options.sweep if (values := scenario_sweep(text))]
    policies = [each for text in options.sweep if not scenario_sweep(text) for each in sweep(text)]
    if options.policies is not None or policies:
        fields["policies"] = [*(options.policies or []), *policies]
    config = StudyConfig(**fields)
    config.scenarios = [":".join(each) for each in product(config.scenarios, *swept)]
    if "policies" not in fields:
        config.policies = default_policies(config.scenarios)
    if "speeds" not in fields:
        config.speeds = own_speeds(config) or config.speeds
    table = cli.call(run_study.run, options, config=config).table
    if table and all(row["infeasible"] == row["flights"] for row in table):
        raise cli.FailureWithResultError(
            "none of the flights could be flown; rollouts.csv has the reasons", table
        )
    return table


@cli.command(
    "replay",
    cli.path_option("study", "the folder of a study"),
    cli.Option("ids", "of flights through one world, see rollouts.csv", nargs="+", metavar="id"),
    cli.flag("--meshcat", "write flight.html, to watch the flight"),
    cli.flag("--video", "write flight.mp4, the onboard video"),
    cli.Option("--rerun FILE", "record the flight for the viewer Rerun", Path, unused=True),
    cli.out_option("folder for these (STUDY/replays/ID)", required=False),
    cli.OVERWRITE,
    examples=(
        "replay out/study P08-reactive-2-003 --meshcat --video",
        "replay out/study P08-planner-2-003 P08-reactive-2-003",
    ),
)
def replay(options: argparse.Namespace) -> None:
    """Flies one flight of a study again, from the study's folder alone, and compares it with its
    record. Exits with status 1 if they differ. Of several flights it writes a page."""
    from splatpilot.analysis.benchmark import replay

    first, *others = options.ids
    if others:
        names = [name for name in ("meshcat", "video", "rerun") if getattr(options, name)]
        found, remedy = ", ".join(f"--{name}" for name in names), "name one flight"
        require(not names, f"{len(options.ids)} flights", "without options", found, remedy)
        cli.call(replay.overlay, options)
    elif not cli.call(replay.run, options, id=first):
        raise ValueError(f"{first}: the replay differs from the recorded flight")


@cli.command(
    "difficulty",
    cli.Option(
        "scenarios",
        "P01 to R17 or YAML files (default: all)",
        nargs="*",
        metavar="SCENARIO",
        resolve=check_scenario,
        completions=SCENARIOS,
    ),
    cli.Option("--seeds", "seeds of each (%(default)s)", int, default=5),
    examples=("difficulty", "difficulty P06 P07 --seeds 10"),
)
def difficulty(options: argparse.Namespace) -> None:
    """Measures worlds before a flight: how far obstacles force it off the straight line, how narrow
    and how cluttered its path is."""
    require(options.seeds >= 1, "--seeds", "at least 1", options.seeds)
    from splatpilot.analysis import difficulty

    cli.call(difficulty.run, options)
