"""What a study consists of, and which ones are refused."""

from dataclasses import replace

import pytest

from splatpilot.analysis.benchmark.rollout import chunks
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig, scenario_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios


def test_rollouts_are_all_combinations(short_scenario):
    """Each scenario, policy, speed and seed is flown once, under a name of its own."""
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    specs = config.rollouts()
    assert len(specs) == len(set(specs)) == len({spec.id for spec in specs}) == 12
    assert {spec.scenario for spec in specs} == {"short"}
    assert RolloutSpec("short", "straight", 1.5, 2) in specs
    assert RolloutSpec("P02", "planner", 2.0, 7).id == "P02-planner-2-007"


def test_chunks_are_flights_through_one_place(short_scenario):
    """All flights are handed out once, in order, never more than the size, nor of two places."""
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    parts = list(chunks(config.rollouts(), 3))
    assert [spec for part in parts for spec in part] == config.rollouts()
    assert [len(part) for part in parts] == [3, 1] * 3
    assert all(len({spec.seed for spec in part}) == 1 for part in parts)


def test_scenario_of_a_flight_has_its_policy_speed_and_seed():
    """The rest is the scenario's."""
    flown = scenario_of(RolloutSpec("a", "planner", 3.0, 5), Scenario(timeout=7.0))
    assert (flown.policy.lattice.speed, flown.seed, flown.timeout) == (3.0, 5, 7.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenarios": ["P99"]}, "there is no scenario 'P99'"),
        ({"scenarios": ["nowhere.yaml"]}, "nowhere.yaml: there is no such file"),
        ({"scenarios": []}, "the study has no scenario"),
        ({"policies": ["plan"]}, r"there is no policy 'plan'; the policies are planner"),
        ({"policies": ["planner", "planner"]}, "the policy planner is given twice"),
        ({"speeds": [-1.0]}, "the speed -1 m/s cannot be flown"),
        ({"speeds": [float("nan")]}, "the speed nan m/s cannot be flown"),
        ({"speeds": [50.0], "policies": ["straight"]}, "speed is 50"),
        ({"seeds": 0}, "seeds is 0; it must be 1 to"),
        ({"overrides": ["world.spacing=0.1"]}, "scenario short: .*spacing"),
        ({"overrides": ["policy.rate=3"]}, "'policy.rate=3' has no place in a study"),
        ({"overrides": ["wrld.spacing=1"]}, "did you mean world"),
    ],
)
def test_bad_study_is_named(short_study, changes, message):
    """Unknown scenarios, policies and speeds, and infeasible parameters, are refused by name."""
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        replace(short_study, **changes).load_scenarios()


def test_all_benchmark_scenarios_load():
    """Every scenario of the benchmark is valid, and found by its name."""
    config = StudyConfig()
    assert config.scenarios == list(benchmark_scenarios())
    if config.scenarios:
        assert set(config.load_scenarios()) == set(config.scenarios)
