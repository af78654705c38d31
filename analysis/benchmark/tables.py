"""The tables of a study."""

import math
from typing import Any, NamedTuple

import numpy as np

from splatpilot.analysis.benchmark.rollout import INFEASIBLE
from splatpilot.analysis.benchmark.statistics import PairedComparison, mcnemar, wilson_interval
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.diagrams.flight import Outcome
from splatpilot.diagrams.scenario_files import benchmark_scenarios

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


def paper_rows(config: StudyConfig) -> dict[str, PaperRow]:
    """The rows of the paper's table that a study has beside it: of the policies that fly as they
    ship, in the benchmark's scenarios as they are, all of them."""
    if config.overrides or set(config.scenarios) != set(benchmark_scenarios()):
        return {}
    return {policy: PAPER[policy] for policy in config.policies if policy in PAPER}


def select(rows: list[dict[str, Any]], **values: object) -> list[dict[str, Any]]:
    """The rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def success_summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Flights, successes, their rate and its 95 % Wilson interval, and how the others ended."""
    successes = sum(row["success"] for row in rows)
    interval = wilson_interval(successes, len(rows))
    return {
        "flights": len(rows),
        "successes": successes,
        "success_rate": successes / len(rows) if rows else math.nan,
        "wilson_lower": interval.lower,
        "wilson_upper": interval.upper,
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


def compare(rows: list[dict[str, Any]], first: str, second: str, speed: float) -> PairedComparison:
    """Two policies on the same scenarios and seeds at a speed."""

    def successes(policy: str) -> np.ndarray:
        flown = select(rows, policy=policy, speed=speed)
        flown.sort(key=lambda row: (row["scenario"], row["seed"]))
        return np.array([row["success"] for row in flown], dtype=bool)

    return mcnemar(successes(first), successes(second))


def format_table(table: list[dict[str, Any]]) -> str:
    """The table of policies for a terminal."""
    width = max([16, *(len(row["policy"]) + 2 for row in table)])
    lines = [
        f"{'policy':<{width}}{'speed':>6}{'success':>12}{'95 % interval':>16}{'scenarios':>11}"
        f"{'clearance':>11}{'velocity':>10}{'not run':>9}"
    ]
    for row in table:
        rate = f"{row['successes']}/{row['flights']}"
        passed = f"{row['scenarios_passed']}/{row['scenarios']}"
        interval = f"{row['wilson_lower']:.0%} to {row['wilson_upper']:.0%}"
        lines.append(
            f"{row['policy']:<{width}}{row['speed']:>6g}{rate:>12}{interval:>16}{passed:>11}"
            f"{row['min_clearance_m']:>+9.2f} m{row['mean_speed_m_s']:>6.2f} m/s{row['not_run']:>9}"
        )
    return "\n".join(lines)
