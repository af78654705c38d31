import numpy as np
import pytest
from scipy.stats import norm

from splatpilot.analysis.benchmark.report import external_section
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.tables import (
    cluster_interval,
    compare,
    effective_flights,
    external_table,
    format_table,
    holm,
    mcnemar,
    paper_rows,
    policy_table,
    scenario_table,
    sign_flip,
    success_summary,
    wilson_interval,
)
from splatpilot.diagrams.scenarios import benchmark_scenarios


@pytest.mark.parametrize(
    ("successes", "flights", "lower", "upper"),
    [
        # R. G. Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (0, 0, 0.0, 1.0),
    ],
)
def test_wilson_interval_is_the_published_one(successes, flights, lower, upper):
    assert wilson_interval(successes, flights) == pytest.approx((lower, upper), abs=5e-5)


def test_mcnemar_is_the_binomial_of_unequal_pairs():
    first = np.repeat([True, False, True, False], [6, 16, 80, 59])
    second = np.repeat([False, True, True, False], [6, 16, 80, 59])
    p_value = pytest.approx(2 * 110056 / 2**22)
    assert mcnemar(first, second) == (6, 16, p_value)
    assert mcnemar(second, first) == (16, 6, p_value)
    assert mcnemar(first, first) == (0, 0, 1.0)


def test_cluster_interval_covers_at_its_confidence():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        rates = rng.beta(2.0, 1.0, size=30)  # of scenarios; the mean is 2/3
        interval = cluster_interval(rng.binomial(10, rates), np.full(30, 10))
        covered += interval.lower <= 2 / 3 <= interval.upper
    assert 0.9 * 200 <= covered <= 0.99 * 200


@pytest.mark.parametrize(
    ("successes", "flights", "expected"),
    [
        ([], [], (0.0, 1.0)),
        ([20], [20], (0.0, 1.0)),
        ([20, 20, 20], [20, 20, 20], wilson_interval(3, 3)),
        ([0, 0], [5, 5], wilson_interval(0, 2)),
        ([5, 5, 5], [10, 10, 10], wilson_interval(1.5, 3)),  # not two of three
    ],
)
def test_cluster_interval_of_equal_or_single_scenarios_is_wide(successes, flights, expected):
    assert cluster_interval(successes, flights) == expected


@pytest.mark.parametrize(
    ("differences", "p_value"),
    [
        ([], 1.0),
        ([0.0, 0.0], 1.0),
        ([0.5], 1.0),
        ([0.5, 0.5, 0.5, 0.5], 2 / 16),
        ([0.5, 0.5, 0.5, -0.5], 10 / 16),
        ([0.1, 0.2, 0.3, 0.0], 2 / 8),
    ],
)
def test_sign_flip_counts_the_signs_of_the_scenarios(differences, p_value):
    assert sign_flip(differences) == p_value


def test_sign_flip_of_many_scenarios_agrees_with_the_normal_distribution():
    differences = np.random.default_rng(1).normal(0.3, 1.0, size=60)
    z = differences.sum() / np.sqrt((differences**2).sum())
    assert sign_flip(differences) == pytest.approx(2 * norm.sf(abs(z)), rel=0.1)


def test_holm_steps_down():
    # By hand: 4 x 0.01, 3 x 0.02, 2 x 0.03 and 0.04, never falling.
    np.testing.assert_allclose(holm([0.04, 0.01, 0.03, 0.02]), [0.06, 0.04, 0.06, 0.06])
    np.testing.assert_allclose(holm([0.9, 0.5]), [1.0, 1.0])
    assert holm([]).shape == (0,)


def flights(policy: str, scenario: str, successes: list[bool]) -> list[dict]:
    outcomes = {True: ("goal", 0.5), False: ("timeout", 0.1)}
    spec = {"policy": policy, "scenario": scenario, "speed": 2.0}
    return [
        spec
        | dict(zip(("outcome", "min_clearance_m"), outcomes[success], strict=True))
        | {"seed": seed, "success": success}
        for seed, success in enumerate(successes)
    ]


def test_table_has_a_row_for_each_policy():
    rows = flights("planner", "P01", [True, True, False]) + flights("planner", "P02", [True, False])
    rows += flights("planner", "P03", [False])
    summary = success_summary(rows)
    assert (summary["scenarios"], summary["scenarios_passed"]) == (3, 1)  # by most flights
    rows += flights("straight", "P01", [True, False])
    config = StudyConfig(["P01", "P02", "P03"], ["planner", "straight"], [2.0], seeds=2)
    table = policy_table(rows, config)
    assert [row["successes"] for row in table] == [3, 1]
    assert [row["timeout"] for row in table] == [3, 1]
    assert [round(row["min_clearance_m"], 6) for row in table] == [0.3, 0.3]
    planner, straight = format_table(table, config).splitlines()[2:]
    assert "3/6" in planner and "1/3" in planner and "0/1" in straight


def test_effective_flights_are_those_over_the_design_effect():
    assert effective_flights([1, 0, 1], [1, 1, 1]) == 3
    assert effective_flights([], []) == 0
    assert effective_flights([4, 4], [4, 4]) == effective_flights([0, 0], [4, 4]) == 2
    # Equal flights of a world count once: 40 worlds of 5 flights are about 40 flights.
    wins = np.repeat([0, 5], 20)
    assert effective_flights(wins, np.full(40, 5)) == pytest.approx(39)
    # Independent ones all count.
    wins = np.random.default_rng(0).binomial(5, 0.6, size=2000)
    assert effective_flights(wins, np.full(2000, 5)) == pytest.approx(10000, rel=0.1)


def test_flights_that_share_worlds_are_clustered():
    # Two vehicles in each of ten worlds: the second policy fails in six worlds, for both.
    variants = ["P01:vehicle.drag=0.3", "P01:vehicle.drag=0.5"]
    config, rows = StudyConfig(variants, ["a", "b"], [2.0], seeds=10), []
    for scenario in config.scenario_variants:
        rows += flights("a", scenario.label, [True] * 10)
        rows += flights("b", scenario.label, [False] * 6 + [True] * 4)
    assert compare(rows, config)[0].p_seeds == 2 / 2**12
    rows = [row | {"world_id": f"P01-{row['seed']:03d}"} for row in rows]
    (pair,) = compare(rows, config)
    assert (pair.only_first, pair.p_seeds) == (12, 2 / 2**6)
    assert pair.p_scenarios == 1.0  # one scenario
    table = policy_table(rows, config)
    assert (table[0]["wilson_lower"], table[0]["wilson_upper"]) == wilson_interval(10, 10)
    assert table[1]["wilson_lower"] == pytest.approx(wilson_interval(3.6, 9).lower)
    assert (table[1]["cluster_lower"], table[1]["cluster_upper"]) == (0.0, 1.0)
    labels = [each.label for each in config.scenario_variants]
    drags = dict(zip(labels, (0.3, 0.5), strict=True))
    rows = [row | {"vehicle.drag": drags[row["scenario"]]} for row in rows]
    table = scenario_table(rows, config)
    assert [(row["policy"], row["vehicle.drag"], row["successes"]) for row in table] == [
        *(("a", 0.3, 10), ("a", 0.5, 10), ("b", 0.3, 4), ("b", 0.5, 4))
    ]
    assert table[2]["wilson_lower"] == pytest.approx(wilson_interval(4, 10).lower)


def test_paper_is_compared_with_unchanged_policies_in_all_scenarios():
    seventeen, policies = list(benchmark_scenarios()), ["planner", "diffaero", "depthnav:rate=12"]
    assert len(seventeen) == 17
    assert list(paper_rows(StudyConfig(seventeen, policies))) == ["diffaero"]
    for other in (["planner"], ["diffaero=planner"]):
        assert paper_rows(StudyConfig(seventeen, other)) == {}
    assert paper_rows(StudyConfig(seventeen[1:], policies)) == {}
    assert paper_rows(StudyConfig(seventeen, policies, overrides=["timeout=5"])) == {}
    assert paper_rows(StudyConfig(seventeen, policies), absent={"R13": "no scene"}) == {}


def test_all_pairs_are_compared_by_flights_and_by_scenarios():
    names, success = [f"P{k:02d}" for k in range(6)], {"a": True, "b": False, "c": False}
    rows = [
        row for p, won in success.items() for name in names for row in flights(p, name, [won] * 2)
    ]
    pairs = compare(rows, StudyConfig(names, ["a", "b", "c"], [2.0], seeds=2))
    assert [(pair.first, pair.second) for pair in pairs] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert [(pair.only_first, pair.only_second) for pair in pairs] == [(12, 0), (12, 0), (0, 0)]
    # Twelve flights in six scenarios: 2 / 2^12 and 2 / 2^6, times three tests.
    assert [pair.p_seeds for pair in pairs] == [6 / 2**12, 6 / 2**12, 1.0]
    assert [pair.p_scenarios for pair in pairs] == [6 / 2**6, 6 / 2**6, 1.0]


def test_published_results_are_compared_with_unchanged_scenarios():
    scenarios = ["P01", "dodgedrone_medium"]
    config = StudyConfig(scenarios, ["straight"], [2.0, 3.0], seeds=2)
    rows = [
        spec._asdict() | {"success": spec[2:] == (2.0, 0), "mean_speed_m_s": spec.speed - 0.5}
        for spec in config.rollouts()
    ]
    table = external_table(rows, config)
    *published, slow, fast = table
    assert {row["scenario"] for row in table} == {"dodgedrone_medium"}
    assert [(row["successes"], row["flights"]) for row in published] == [(187, 303), (130, 303)]
    assert all(row["speed"] is None for row in published)
    courses = wilson_interval(187 / 303 * 101, 101)  # Three flights on each are alike.
    assert (published[0]["wilson_lower"], published[0]["wilson_upper"]) == pytest.approx(courses)
    assert (slow["policy"], slow["speed"], slow["successes"], slow["flights"]) == (
        ("straight", 2.0, 1, 2)
    )
    assert (fast["successes"], fast["mean_speed_m_s"]) == (0, 2.5)
    assert fast["wilson_lower"] == pytest.approx(0.0) and 0 < fast["wilson_upper"] < 1
    text = external_section(table)
    assert text.index("187/303") < text.index("1/2") and "arseniid/agile_flight" in text

    assert external_table(rows, StudyConfig(["P01"], ["straight"])) == []
    config.overrides = ["timeout=100"]
    assert external_table(rows, config) == [] and external_section([]) == ""
