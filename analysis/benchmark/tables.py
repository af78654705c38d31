"""The tables of a study."""

import math
from collections import Counter
from collections.abc import Collection
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest

from splatpilot.analysis.benchmark.rollout import INFEASIBLE
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.diagrams.flight.flight import Outcome
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.seeds import describe_seeds
from splatpilot.training.corpus.library import PROCEDURAL

# How far successes of a finite number of flights can be trusted.
#
# Two questions have two answers. Wilson's interval and McNemar's test take flights as independent:
# they hold for these scenarios with new seeds. Flights of one scenario share what makes it hard, so
# the cluster bootstrap and the sign-flip test take scenarios as independent: they hold for new
# scenarios of the same kinds.


_RESAMPLES = 9999
_EXACT = 17
"""Up to so many scenarios all 2^n signs are tried, of more scenarios as many random ones."""


class Interval(NamedTuple):
    """A confidence interval."""

    lower: float
    upper: float


def wilson_interval(successes: int, flights: int, confidence: float = 0.95) -> Interval:
    """The score interval of a success rate (E. B. Wilson, 1927), all of [0, 1] without flights."""
    if flights == 0:
        return Interval(0.0, 1.0)
    interval = binomtest(successes, flights).proportion_ci(confidence, method="wilson")
    return Interval(float(interval.low), float(interval.high))


def cluster_interval(
    successes: ArrayLike, flights: ArrayLike, confidence: float = 0.95
) -> Interval:
    """
    Returns the percentile interval of a success rate by a bootstrap over scenarios.

    Fewer than two scenarios say nothing about others. If all have the same rate, resampling shows
    no spread, and the interval is Wilson's with each scenario counted as one flight.

    Args:
        successes, flights: of each scenario, (S,).
    """
    k, n = np.asarray(successes, float), np.asarray(flights, float)
    if len(k) < 2:
        return Interval(0.0, 1.0)
    if np.ptp(k / n) == 0:
        return wilson_interval(round(float(k.sum() / n.sum()) * len(k)), len(k), confidence)
    drawn = np.random.default_rng(0).integers(len(k), size=(_RESAMPLES, len(k)))
    rates = k[drawn].sum(axis=1) / n[drawn].sum(axis=1)
    lower, upper = np.quantile(rates, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(lower), float(upper))


class PairedCounts(NamedTuple):
    """Two policies on the same flights."""

    only_first: int
    """Flights in which only the first succeeded."""
    only_second: int
    """Flights in which only the second did."""
    p_value: float
    """Probability of a difference as large if the policies were equally good."""


def mcnemar(first: np.ndarray, second: np.ndarray) -> PairedCounts:
    """The exact test of McNemar (Psychometrika 12, 1947) on paired successes (n,) bool.

    Where both policies succeed or both fail says nothing; of the other flights each would be won by
    either with probability one half, so that the count of one is binomial.
    """
    only_first = int(np.count_nonzero(first & ~second))
    only_second = int(np.count_nonzero(second & ~first))
    unequal = only_first + only_second
    p_value = float(binomtest(only_first, unequal).pvalue) if unequal else 1.0
    return PairedCounts(only_first, only_second, p_value)


def sign_flip(differences: ArrayLike) -> float:
    """
    Returns the two-sided p-value of a paired sign-flip permutation test over scenarios.

    If the policies were equally good in scenarios of these kinds, the difference of their success
    rates in a scenario would have either sign with probability one half.

    Args:
        differences: of the success rates of two policies in each scenario, (S,).
    """
    d = np.asarray(differences, float)
    d = d[d != 0]
    if len(d) <= _EXACT:
        bits = np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1
    else:
        bits = np.random.default_rng(0).integers(2, size=(2**_EXACT, len(d)))
        bits[0] = 0  # what was observed is one of the possibilities
    sums = np.abs((1 - 2 * bits) @ d)
    return float(np.mean(sums >= abs(d.sum()) - 1e-12))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Returns p-values (m,) corrected for the number of tests (S. Holm, Scand. J. Statistics 6,
    1979): the chance of any false positive among them stays below the level."""
    p = np.asarray(p_values, float)
    order = np.argsort(p)
    steps = (len(p) - np.arange(len(p))) * p[order]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


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
