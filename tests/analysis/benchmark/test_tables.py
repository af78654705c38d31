"""Tables of flights made up by hand."""

from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.tables import (
    compare,
    format_table,
    paper_rows,
    policy_table,
    scenarios_passed,
)
from splatpilot.diagrams.scenarios import benchmark_scenarios


def flights(policy: str, scenario: str, successes: list[bool]) -> list[dict]:
    return [
        {
            "policy": policy,
            "scenario": scenario,
            "speed": 2.0,
            "seed": seed,
            "success": success,
            "outcome": "goal" if success else "timeout",
            "min_clearance_m": 0.5 if success else 0.1,
        }
        for seed, success in enumerate(successes)
    ]


def test_scenario_is_passed_where_most_flights_succeed():
    rows = flights("a", "P01", [True, True, False]) + flights("a", "P02", [True, False])
    rows += flights("a", "P03", [False])
    assert scenarios_passed(rows) == {"scenarios": 3, "scenarios_passed": 1}


def test_table_has_a_row_for_each_policy():
    rows = flights("planner", "P01", [True, True]) + flights("straight", "P01", [True, False])
    config = StudyConfig(["P01"], ["planner", "straight"], [2.0], seeds=2)
    table = policy_table(rows, config)
    assert [row["successes"] for row in table] == [2, 1]
    assert [row["scenarios_passed"] for row in table] == [1, 0]
    assert [row["timeout"] for row in table] == [0, 1]
    assert [round(row["min_clearance_m"], 6) for row in table] == [0.5, 0.3]
    planner, straight = format_table(table, config).splitlines()[2:]
    assert "2/2" in planner and "1/1" in planner and "0/1" in straight


def test_paper_stands_beside_what_it_is_about():
    seventeen = list(benchmark_scenarios())
    assert len(seventeen) == 17
    policies = ["planner", "diffaero", "depthnav:camera.width=128"]
    assert list(paper_rows(StudyConfig(seventeen, policies))) == ["diffaero"]
    assert paper_rows(StudyConfig(seventeen, ["planner"])) == {}
    assert paper_rows(StudyConfig(seventeen, ["diffaero=planner"])) == {}
    assert paper_rows(StudyConfig(seventeen[1:], policies)) == {}
    assert paper_rows(StudyConfig(seventeen, policies, overrides=["timeout=5"])) == {}
    assert paper_rows(StudyConfig(seventeen, policies), absent={"R13": "no scene"}) == {}


def test_interval_of_a_policy_counts_scenarios_as_clusters():
    rows = [row for k in range(10) for row in flights("a", f"P{k:02d}", 20 * [k < 5])]
    (row,) = policy_table(rows, StudyConfig([], ["a"], [2.0], seeds=20))
    assert (row["successes"], row["flights"]) == (100, 200)
    assert row["wilson_upper"] - row["wilson_lower"] < 0.15
    assert row["cluster_upper"] - row["cluster_lower"] > 0.5


def test_all_pairs_are_compared_by_flights_and_by_scenarios():
    names = [f"P{k:02d}" for k in range(6)]
    rows = [row for name in names for row in flights("a", name, [True, True])]
    rows += [row for name in names for row in flights("b", name, [False, False])]
    rows += [row for name in names for row in flights("c", name, [False, False])]
    pairs = compare(rows, StudyConfig(names, ["a", "b", "c"], [2.0], seeds=2))
    assert [(pair.first, pair.second) for pair in pairs] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert [(pair.only_first, pair.only_second) for pair in pairs] == [(12, 0), (12, 0), (0, 0)]
    # Twelve flights in six scenarios: 2 / 2^12 and 2 / 2^6, times three tests.
    assert [pair.p_seeds for pair in pairs] == [6 / 2**12, 6 / 2**12, 1.0]
    assert [pair.p_scenarios for pair in pairs] == [6 / 2**6, 6 / 2**6, 1.0]
