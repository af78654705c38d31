"""The tables of a study."""

import math
from collections import Counter
from collections.abc import Collection
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from splatpilot.analysis.benchmark.rollout import INFEASIBLE
from splatpilot.analysis.benchmark.statistics import (
    cluster_interval,
    holm,
    mcnemar,
    sign_flip,
    wilson_interval,
)
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.diagrams.flight import Outcome
from splatpilot.diagrams.scenario_files import benchmark_scenarios
from splatpilot.systems.seeds import describe_seeds
from splatpilot.training.world_kinds import PROCEDURAL

FAILURES = Outcome.COLLISION, Outcome.TIMEOUT, Outcome.LEFT_VOLUME, Outcome.ERROR, INFEASIBLE
"""The outcomes that tables count, next to the successes."""

MEASURES = (
    "min_clearance_m",
    "mean_speed_m_s",
    "path_excess",
    "jerk_m_s3",
    "smoothness",
)
"""Columns of which the table has the mean over the flights that have them."""


class PaperRow(NamedTuple):
    """A row of the paper's Table I: 17 scenarios, one flight each."""

    method: str
    successes: int
    min_clearance_m: float
    mean_speed_m_s: float


PAPER = {
    "diffaero": PaperRow("DiffAero", 16, 0.37, 2.12),
    "depthnav": PaperRow("DepthNav", 14, 0.30, 2.31),
    "agile_autonomy": PaperRow("Agile Autonomy", 5, -0.01, 2.50),
    "student_depth": PaperRow("Depth", 10, 0.33, 2.28),
    "student_rgb": PaperRow("RGB", 5, -0.09, 2.51),
}
"""The paper's Table I, by the names of our policies."""

PAPER_FLIGHTS = 17

IN_DISTRIBUTION = (*PROCEDURAL, "R17")
"""Scenarios made by the generators in which the shipped weights were trained, of other seeds."""


def paper_rows(config: StudyConfig, absent: Collection[str] = ()) -> dict[str, PaperRow]:
    """Returns the rows of the paper's table that a study is compared with: of policies that fly as
    they ship, if all of the benchmark's scenarios were flown as they are and none is `absent`."""
    if absent or config.overrides or set(config.scenarios) != set(benchmark_scenarios()):
        return {}
    return {policy: PAPER[policy] for policy in config.policies if policy in PAPER}


def select(rows: list[dict[str, Any]], **values: object) -> list[dict[str, Any]]:
    """The rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def success_summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts flights, successes and how the others ended, and gives the success rate with its 95 %
    intervals: Wilson's for these scenarios, and by clusters for new ones of the same kinds."""
    successes = sum(row["success"] for row in rows)
    interval = wilson_interval(successes, len(rows))
    flights = Counter(row["scenario"] for row in rows)
    wins = Counter(row["scenario"] for row in rows if row["success"])
    clusters = cluster_interval([wins[name] for name in flights], list(flights.values()))
    return {
        "flights": len(rows),
        "successes": successes,
        "success_rate": successes / len(rows) if rows else math.nan,
        "wilson_lower": interval.lower,
        "wilson_upper": interval.upper,
        "cluster_lower": clusters.lower,
        "cluster_upper": clusters.upper,
    } | {str(outcome): sum(row["outcome"] == outcome for row in rows) for outcome in FAILURES}


def mean_of(rows: list[dict[str, Any]], name: str) -> float:
    """The mean of a column over the rows that have a number there; NaN without any."""
    values = [row[name] for row in rows if math.isfinite(row.get(name, math.nan))]
    return float(np.mean(values)) if values else math.nan


def policy_table(
    rows: list[dict[str, Any]], config: StudyConfig, absent: int = 0
) -> list[dict[str, Any]]:
    """A row for each policy and speed: `success_summary`, in how many of the scenarios flown most
    flights succeed, the flights that were not run because `absent` scenarios have no scene here,
    and the means of `MEASURES`."""
    table = []
    for policy in config.policy_names:
        for speed in config.speeds:
            flown = select(rows, policy=policy, speed=speed)
            table.append(
                {"policy": policy, "speed": speed}
                | success_summary(flown)
                | scenarios_passed(flown)
                | {"not_run": absent * config.seeds}
                | {name: mean_of(flown, name) for name in MEASURES}
            )
    return table


def scenarios_passed(rows: list[dict[str, Any]]) -> dict[str, int]:
    """How many scenarios the flights are in, and in how many more than half of them succeed."""
    successes: dict[str, list[bool]] = {}
    for row in rows:
        successes.setdefault(row["scenario"], []).append(row["success"])
    passed = sum(2 * sum(flights) > len(flights) for flights in successes.values())
    return {"scenarios": len(successes), "scenarios_passed": passed}


class Comparison(NamedTuple):
    """Two policies on the same scenarios and seeds at a speed."""

    first: str
    second: str
    speed: float  # [m/s]
    only_first: int  # flights in which only the first succeeded
    only_second: int
    p_seeds: float  # McNemar's: for these scenarios with new seeds
    p_scenarios: float  # of sign flips: for new scenarios of the same kinds


def compare(rows: list[dict[str, Any]], config: StudyConfig) -> list[Comparison]:
    """Compares all pairs of a study's policies at each speed. Holm's correction for the number of
    pairs is in the p-values."""

    def wins(policy: str, speed: float) -> np.ndarray:  # (scenarios, seeds), of one order
        flown = select(rows, policy=policy, speed=speed)
        flown.sort(key=lambda row: (row["scenario"], row["seed"]))
        return np.array([row["success"] for row in flown], dtype=bool).reshape(-1, config.seeds)

    pairs = []
    for speed in config.speeds:
        for names in combinations(config.policy_names, 2):
            first, second = (wins(name, speed) for name in names)
            p_scenarios = sign_flip(first.mean(axis=1) - second.mean(axis=1))
            pairs.append(Comparison(*names, speed, *mcnemar(first, second), p_scenarios))
    for name in ("p_seeds", "p_scenarios"):
        adjusted = holm([getattr(pair, name) for pair in pairs])
        pairs = [p._replace(**{name: float(a)}) for p, a in zip(pairs, adjusted, strict=True)]
    return pairs


def format_table(table: list[dict[str, Any]], config: StudyConfig) -> str:
    """Formats the table of policies for a terminal."""
    width = max([16, *(len(row["policy"]) + 2 for row in table)])
    lines = [
        f"{describe_seeds(config.split, config.seeds)}; 95 % intervals for these scenarios "
        "(Wilson) and for new ones of the same kinds (bootstrap over scenarios)",
        f"{'policy':<{width}}{'speed':>6}{'success':>12}{'these':>16}{'new':>16}{'scenarios':>11}"
        f"{'clearance':>11}{'velocity':>10}{'not run':>9}",
    ]
    for row in table:
        rate = f"{row['successes']}/{row['flights']}"
        passed = f"{row['scenarios_passed']}/{row['scenarios']}"
        these, new = (
            f"{row[f'{kind}_lower']:.0%} to {row[f'{kind}_upper']:.0%}"
            for kind in ("wilson", "cluster")
        )
        lines.append(
            f"{row['policy']:<{width}}{row['speed']:>6g}{rate:>12}{these:>16}{new:>16}{passed:>11}"
            f"{row['min_clearance_m']:>+9.2f} m{row['mean_speed_m_s']:>6.2f} m/s{row['not_run']:>9}"
        )
    return "\n".join(lines)
