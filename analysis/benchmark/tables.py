"""The tables of a study, with intervals and tests."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, norm

from splatpilot.analysis.benchmark.rollout import INFEASIBLE
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.diagrams.flight.monitor import Outcome
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.provenance import describe_seeds
from splatpilot.training.corpus.library import PROCEDURAL

# Wilson's interval and McNemar's test take worlds as independent: they hold for these scenarios
# with new seeds. If flights share worlds, the interval is of `effective_flights`, and the test is
# that of sign flips over worlds, which equals McNemar's for worlds of one flight. The cluster
# bootstrap and the sign-flip test take scenarios as independent, whose flights are correlated: they
# hold for new scenarios of the same kinds.

Row = dict[str, Any]
"""The specification and metrics of a flight, or a row of a table."""

_CONFIDENCE = 0.95
_RESAMPLES = 9999
_MAX_EXACT = 17  # scenarios with all 2^n signs; for more, as many random ones


class Interval(NamedTuple):
    """A confidence interval."""

    lower: float
    upper: float


def wilson_interval(successes: float, flights: float) -> Interval:
    """Returns the score interval of a success rate (E. B. Wilson, 1927) of independent flights, see
    `effective_flights`; [0, 1] without flights."""
    if flights == 0:
        return Interval(0.0, 1.0)
    p, z2 = successes / flights, float(norm.ppf((1 + _CONFIDENCE) / 2)) ** 2
    center = (p + z2 / (2 * flights)) / (1 + z2 / flights)
    half = math.sqrt(z2 * (p * (1 - p) + z2 / (4 * flights)) / flights) / (1 + z2 / flights)
    lower, upper = max(center - half, 0.0), min(center + half, 1.0)
    return Interval(0.0 if p == 0 else lower, 1.0 if p == 1 else upper)


def effective_flights(successes: ArrayLike, flights: ArrayLike) -> float:
    """Returns the number of independent flights that are as informative as those of worlds (W,).

    It is the number of flights over the design effect (L. Kish, Survey Sampling, 1965): the
    variance of the success rate by worlds over that of independent flights. If all or none succeed
    it is the number of worlds.
    """
    k, n = np.asarray(successes, float), np.asarray(flights, float)
    total, worlds = n.sum(), len(n)
    rate = k.sum() / total if total else 0.0
    if worlds == total:
        return float(total)
    if worlds < 2 or rate in (0.0, 1.0):
        return float(worlds)
    between = np.square(k - rate * n).sum() * worlds / (worlds - 1) / total**2
    return float(np.clip(rate * (1 - rate) / between, 1.0, total)) if between else float(total)


def cluster_interval(successes: ArrayLike, flights: ArrayLike) -> Interval:
    """Returns the percentile interval of a success rate by a bootstrap over scenarios (S,).

    It is [0, 1] for fewer than two scenarios. If all have the same rate, it is Wilson's with each
    scenario counted as one flight.
    """
    k, n = np.asarray(successes, float), np.asarray(flights, float)
    if len(k) < 2:
        return Interval(0.0, 1.0)
    if np.ptp(k / n) == 0:
        return wilson_interval(float(k.sum() / n.sum()) * len(k), len(k))
    drawn = np.random.default_rng(0).integers(len(k), size=(_RESAMPLES, len(k)))
    rates = k[drawn].sum(axis=1) / n[drawn].sum(axis=1)
    lower, upper = np.quantile(rates, [(1 - _CONFIDENCE) / 2, (1 + _CONFIDENCE) / 2])
    return Interval(float(lower), float(upper))


def mcnemar(first: np.ndarray, second: np.ndarray) -> tuple[int, int, float]:
    """Computes the exact test of McNemar (Psychometrika 12, 1947) of successes (n,) in the same
    flights: how often only the first succeeds, how often only the second, and the p-value."""
    only_first = int(np.count_nonzero(first & ~second))
    only_second = int(np.count_nonzero(second & ~first))
    unequal = only_first + only_second
    return only_first, only_second, float(binomtest(only_first, unequal).pvalue) if unequal else 1.0


def sign_flip(differences: ArrayLike) -> float:
    """Computes the two-sided p-value of a paired sign-flip permutation test over scenarios, from
    the differences (S,) between success rates of two policies."""
    d = np.asarray(differences, float)
    d = d[d != 0]
    if len(d) <= _MAX_EXACT:
        bits = np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1
    else:
        bits = np.random.default_rng(0).integers(2, size=(2**_MAX_EXACT, len(d)), dtype=np.uint8)
        bits[0] = 0  # the observation
    parts = np.array_split(bits, 1 + bits.size // 2**22)  # whose floats fit in memory
    sums = np.abs(d.sum() - 2.0 * np.concatenate([part @ d for part in parts]))
    return float(np.mean(sums >= abs(d.sum()) - 1e-12))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Corrects p-values (m,) for multiple tests (S. Holm, Scand. J. Stat. 6, 1979)."""
    p = np.asarray(p_values, float)
    order = np.argsort(p)
    steps = (len(p) - np.arange(len(p))) * p[order]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


FAILURES = Outcome.COLLISION, Outcome.TIMEOUT, Outcome.LEFT_VOLUME, Outcome.ERROR, INFEASIBLE
"""The outcomes that tables count, besides successes."""

METRICS = "min_clearance_m", "mean_speed_m_s", "path_excess", "jerk_m_s3", "smoothness"
"""Columns whose means are in the table, over the flights that have them."""


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
"""The paper's Table I, by names of our policies."""

PAPER_FLIGHTS = 17

IN_DISTRIBUTION = (*PROCEDURAL, "R17")
"""Scenarios of the generators in which the shipped weights were trained, with other seeds."""

PUBLISHED = {
    "dodgedrone_easy": [],
    "dodgedrone_medium": [
        ("NMPC, knows the obstacles [1]", 2.9, 187, 303, 101),
        ("PPO, knows the obstacles [1]", 2.8, 130, 303, 101),
    ],
    "dodgedrone_hard": [
        ("NMPC, knows the obstacles [1]", 2.9, 35, 303, 101),
        ("PPO, knows the obstacles [1]", 2.8, 22, 303, 101),
        ("FlightEvo, sees depth [2]", 3.0, 0, 20, 20),
    ],
}
"""Published results: method, mean speed [m/s], successes, flights, courses, by levels of the
DodgeDrone challenge."""

DODGEDRONE_SPEEDS = 2.0, 3.0, 5.0, 7.0  # [m/s]

SOURCES = (
    "[1] github.com/arseniid/agile_flight, final_evaluation: courses 0 to 100 of the challenge, "
    "three flights each, in at most 70 s; NMPC with a horizon of 12, PPO 39. "
    "[2] github.com/ykeuter/flightevo, analysis, the winner of the challenge by vision: member 4, "
    "courses 20 to 39; 28.4 m on average until the first hit. "
    "Brackets are Wilson's 95 % intervals, of this scenario with other courses, as if flights on "
    "one course were alike. Their vehicles collide if their center is in a sphere, ours if a "
    "sphere of 0.354 m about its center does."
)


def paper_rows(config: StudyConfig, absent: Collection[str] = ()) -> dict[str, PaperRow]:
    """Returns the rows of the paper's table for unchanged policies, if the study flies all of the
    benchmark's scenarios unchanged."""
    if absent or config.overrides or set(config.scenarios) != set(benchmark_scenarios()):
        return {}
    return {policy: PAPER[policy] for policy in config.policies if policy in PAPER}


def select(rows: list[Row], **values: object) -> list[Row]:
    """Returns the rows with these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def mean_column(rows: list[Row], name: str) -> float:
    """Computes the mean of a column over the rows with a number; NaN without any."""
    values = [row[name] for row in rows if math.isfinite(row.get(name, math.nan))]
    return float(np.mean(values)) if values else math.nan


def _success(successes: int, flights: int, effective: float | None = None) -> Row:
    independent = flights if effective is None else effective
    rate = successes / flights if flights else 0.0
    interval = wilson_interval(rate * independent, independent)
    return {
        "flights": flights,
        "successes": successes,
        "success_rate": successes / flights if flights else math.nan,
        "wilson_lower": interval.lower,
        "wilson_upper": interval.upper,
    }


def _world(row: Row) -> str:
    return str(row.get("world_id", f"{row['scenario']}-{row['seed']}"))


def success_summary(rows: list[Row], bases: Mapping[str, str] | None = None) -> Row:
    """Counts flights by outcome, and scenarios, which are passed if most of their flights succeed.

    The success rate has 95 % intervals: Wilson's for these scenarios, and by clusters for new ones
    of the same kinds.

    Args:
        bases: names of the scenarios without changed fields, by those of their variants.
    """
    wins, flights = _count(rows, lambda row: row["scenario"])
    named: dict[Any, str] = dict(bases or {})
    bootstrapped = _count(rows, lambda row: named.get(row["scenario"]) or row["scenario"])
    clusters = cluster_interval(*bootstrapped)
    return (
        _success(sum(wins), len(rows), effective_flights(*_count(rows, _world)))
        | {"cluster_lower": clusters.lower, "cluster_upper": clusters.upper}
        | {str(outcome): sum(row["outcome"] == outcome for row in rows) for outcome in FAILURES}
        | {"scenarios": len(flights)}
        | {"scenarios_passed": sum(2 * k > n for k, n in zip(wins, flights, strict=True))}
    )


def _count(rows: list[Row], key: Callable[[Row], str]) -> tuple[list[int], list[int]]:
    """Returns the numbers of successes and of flights with each value of a key."""
    flights = Counter(map(key, rows))
    wins = Counter(key(row) for row in rows if row["success"])
    return [wins[name] for name in flights], list(flights.values())


def policy_table(rows: list[Row], config: StudyConfig, absent: int = 0) -> list[Row]:
    """Returns a row for each policy and speed: `success_summary`, the number of flights not run in
    `absent` scenarios, and the means of `METRICS`."""
    table, bases = [], {each.label: each.base for each in config.scenario_variants}
    for policy, speed in product(config.policy_names, config.speeds):
        flown = select(rows, policy=policy, speed=speed)
        table.append(
            {"policy": policy, "speed": speed}
            | success_summary(flown, bases)
            | {"not_run": absent * config.seeds}
            | {name: mean_column(flown, name) for name in METRICS}
        )
    return table


def scenario_table(rows: list[Row], config: StudyConfig) -> list[Row]:
    """Returns a row for each policy, speed and scenario: the scenario's changed fields, successes
    with Wilson's interval, and the means of `METRICS`."""
    table, keys = [], product(config.policy_names, config.speeds, config.scenario_variants)
    for policy, speed, scenario in keys:
        if flown := select(rows, policy=policy, speed=speed, scenario=scenario.label):
            worlds, successes = _count(flown, _world), sum(row["success"] for row in flown)
            table.append(
                {"policy": policy, "speed": speed, "scenario": scenario.label}
                | {name: flown[0].get(name) for name in scenario.fields}
                | _success(successes, len(flown), effective_flights(*worlds))
                | {name: mean_column(flown, name) for name in METRICS}
            )
    return table


def external_table(rows: list[Row], config: StudyConfig) -> list[Row]:
    """Returns, for each published scenario that a study flies unchanged, a row for each published
    result, and then for each of the study's policies and speeds."""
    table = []
    for scenario in config.scenarios if not config.overrides else ():
        if scenario not in PUBLISHED:
            continue
        entries: list[tuple] = [(method, None, *rest) for method, *rest in PUBLISHED[scenario]]
        for policy, speed in product(config.policy_names, config.speeds):
            flown = select(rows, scenario=scenario, policy=policy, speed=speed)
            successes = sum(row["success"] for row in flown)
            mean_speed, flights = mean_column(flown, "mean_speed_m_s"), len(flown)
            entries.append((policy, speed, mean_speed, successes, flights, flights))
        for policy, speed, mean_speed, *counts in entries:
            row = {"scenario": scenario, "policy": policy, "speed": speed}
            table.append(row | {"mean_speed_m_s": mean_speed} | _success(*counts))
    return table


class Comparison(NamedTuple):
    """Two policies on the same scenarios and seeds at a speed."""

    first: str
    second: str
    speed: float  # [m/s]
    only_first: int  # flights in which only the first succeeded
    only_second: int
    # McNemar's, or of sign flips over worlds that flights share, for these scenarios with new seeds
    p_seeds: float
    p_scenarios: float  # of sign flips, for new scenarios of the same kinds


def compare(rows: list[Row], config: StudyConfig) -> list[Comparison]:
    """Compares all pairs of a study's policies at each speed, with Holm's correction."""
    bases = {each.label: each.base for each in config.scenario_variants}
    ordered = sorted(rows, key=lambda row: (row["scenario"], row["seed"]))
    pairs = []
    for speed in config.speeds:
        flown = {name: select(ordered, policy=name, speed=speed) for name in config.policy_names}
        for names in combinations(config.policy_names, 2):
            first, second = (np.array([r["success"] for r in flown[name]], bool) for name in names)
            worlds = [_world(row) for row in flown[names[0]]]
            kinds = [bases[row["scenario"]] for row in flown[names[0]]]
            only_first, only_second, p_seeds = mcnemar(first, second)
            difference = first.astype(float) - second
            if len(set(worlds)) < len(worlds):
                p_seeds = sign_flip(_sum_by(worlds, difference))
            counts = _sum_by(kinds, np.ones(len(kinds)))
            p_scenarios = sign_flip(_sum_by(kinds, difference) / counts)
            pairs.append(Comparison(*names, speed, only_first, only_second, p_seeds, p_scenarios))
    for name in ("p_seeds", "p_scenarios"):
        adjusted = holm([getattr(pair, name) for pair in pairs])
        pairs = [p._replace(**{name: float(a)}) for p, a in zip(pairs, adjusted, strict=True)]
    return pairs


def _sum_by(keys: list[str], values: np.ndarray) -> np.ndarray:
    """Returns the sums of values (N,) of equal keys."""
    _, index = np.unique(keys, return_inverse=True)
    return np.bincount(index, weights=values) if len(keys) else np.zeros(0)


def format_table(table: list[Row], config: StudyConfig) -> str:
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
            f"{row['min_clearance_m']:>+z9.2f} m{row['mean_speed_m_s']:>6.2f} m/s"
            f"{row['not_run']:>9}"
        )
    return "\n".join(lines)
