"""The table of others' scenarios."""

import pytest

from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.external import (
    DODGEDRONE,
    DODGEDRONE_SPEEDS,
    external_table,
    format_external,
)
from splatpilot.analysis.benchmark.report import external_section
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import BENCHMARK_POLICIES, policy_named

CONFIG = StudyConfig(
    scenarios=["P01", "dodgedrone_medium"], policies=["straight"], speeds=[2.0, 3.0], seeds=2
)
ROWS = [
    {"scenario": spec.scenario, "policy": spec.policy, "speed": spec.speed, "seed": spec.seed}
    | {"success": spec.speed == 2.0 and spec.seed == 0, "mean_speed_m_s": spec.speed - 0.5}
    for spec in CONFIG.rollouts()
]


def test_published_figures_stand_before_our_own():
    table = external_table(ROWS, CONFIG)
    assert {row["scenario"] for row in table} == {"dodgedrone_medium"}
    *published, slow, fast = table
    assert [(row["successes"], row["flights"]) for row in published] == [(187, 303), (130, 303)]
    assert all(row["speed"] is None for row in published)
    assert (slow["policy"], slow["speed"], slow["successes"], slow["flights"]) == (
        ("straight", 2.0, 1, 2)
    )
    assert (fast["successes"], fast["mean_speed_m_s"]) == (0, 2.5)
    assert fast["wilson_lower"] == pytest.approx(0.0) and 0 < fast["wilson_upper"] < 1
    for text in (format_external(table), external_section(ROWS, CONFIG)):
        assert text.index("187/303") < text.index("1/2") and "arseniid/agile_flight" in text


def test_only_scenarios_as_they_are_are_compared():
    assert external_table(ROWS, StudyConfig(scenarios=["P01"], policies=["straight"])) == []
    CONFIG_CHANGED = StudyConfig(**(vars(CONFIG) | {"overrides": ["timeout=100"]}))
    assert external_table(ROWS, CONFIG_CHANGED) == []
    assert external_section(ROWS, CONFIG_CHANGED) == ""


def test_one_command_flies_the_challenge(monkeypatch, tmp_path):
    studies = []
    monkeypatch.setattr(benchmark, "run", lambda *, config, **_: studies.append(config))
    command = ["benchmark", "--dodgedrone", "--out", str(tmp_path)]
    main(command)
    main([*command, "--scenarios", "dodgedrone_easy", "--speeds", "3", "--seeds", "2"])
    whole, part = studies
    assert tuple(whole.scenarios) == DODGEDRONE and tuple(whole.speeds) == (2.0, 3.0, 5.0, 7.0)
    assert tuple(whole.policies) == BENCHMARK_POLICIES and whole.seeds == 20
    assert (part.scenarios, part.speeds, part.seeds) == (["dodgedrone_easy"], [3.0], 2)
    assert len(whole.load_scenarios()) == 3


@pytest.mark.parametrize("policy", BENCHMARK_POLICIES)
def test_all_policies_fly_at_its_speeds(policy):
    for speed in DODGEDRONE_SPEEDS:
        policy_named(policy, speed)
