"""What a study consists of, and which ones are refused."""

from dataclasses import replace

import pytest

from splatpilot.analysis.benchmark.rollout import chunks
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig, default_policies
from splatpilot.diagrams.scenarios import benchmark_scenarios


def test_rollouts_are_all_combinations(short_scenario):
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    specs = config.rollouts()
    assert len(specs) == len(set(specs)) == len({spec.id for spec in specs}) == 12
    assert {spec.scenario for spec in specs} == {"short"}
    assert RolloutSpec("short", "straight", 1.5, 2) in specs
    assert RolloutSpec("P02", "planner", 2.0, 7).id == "P02-planner-2-007"


@pytest.mark.parametrize(("split", "seeds"), [("dev", {0, 1}), ("test", {1000, 1001})])
def test_split_decides_the_seeds(short_scenario, split, seeds):
    config = StudyConfig([str(short_scenario)], ["straight"], seeds=2, split=split)
    assert {spec.seed for spec in config.rollouts()} == seeds


def test_chunks_are_flights_through_one_place(short_scenario):
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    flights = [(spec, spec.id) for spec in config.rollouts()]
    parts = list(chunks(flights, 3))
    assert [flight for part in parts for flight in part] == flights
    assert [len(part) for part in parts] == [3, 1] * 3
    assert all(len({spec.seed for spec, _ in part}) == 1 for part in parts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenarios": ["P99"]}, "there is no scenario 'P99'"),
        ({"scenarios": ["nowhere.yaml"]}, "No such file: .*nowhere.yaml"),
        ({"scenarios": []}, "the study has no scenario"),
        ({"policies": ["plan"]}, r"there is no policy 'plan'; did you mean planner"),
        ({"policies": ["planner", "planner"]}, "the policy planner is given twice"),
        ({"policies": ["a=straight", "a=planner"]}, "the policy a is given twice"),
        ({"policies": ["reactive:margn=0.2"]}, "policy reactive-margn-0.2: .*did you mean margin"),
        (
            {"policies": ["straight:rate=-1"]},
            "straight-rate--1: StraightConfig.rate .* got -1",
        ),
        ({"policies": ["scenario"]}, "short.yaml has no `policy`, which --policies scenario would"),
        ({"speeds": [2.0, 2.0000001]}, "the speed 2 is given twice"),
        ({"speeds": [-1.0]}, "speeds .* 20] m/s, got -1"),
        ({"speeds": [float("nan")]}, "speeds .* got nan"),
        ({"speeds": [50.0], "policies": ["straight"]}, "speeds .* got 50"),
        ({"seeds": 0}, r"seeds of split dev must be in \[1, 100\], got 0"),
        ({"seeds": 101}, r"seeds of split dev must be in \[1, 100\], got 101"),
        ({"split": "fresh"}, "split must be one of dev, test, got 'fresh'"),
        ({"overrides": ["world.spacing=0.1"]}, "scenario short: .*spacing"),
        ({"overrides": ["policy.rate=3"]}, "write --policies NAME:rate=3"),
        ({"overrides": ["seed=3"]}, "give their number with --seeds"),
        ({"overrides": ["wrld.spacing=1"]}, "did you mean world"),
    ],
)
def test_bad_study_is_named(short_study, changes, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        replace(short_study, **changes).load_scenarios()


def test_flights_of_one_name_are_refused(short_scenario):
    other = short_scenario.with_name("short-a.yaml")
    other.write_text(short_scenario.read_text())
    config = StudyConfig([str(short_scenario), str(other)], ["a-b=planner", "b=planner"], seeds=1)
    with pytest.raises(ValueError, match="the flight short-a-b-2-000 is given twice"):
        config.load_scenarios()


OWN = "policy: !ReactiveConfig {speed: 1.5, margin: 0.4}\n"


def test_own_policies_fly_where_nobody_is_named(short_scenario):
    own = short_scenario.with_name("own.yaml")
    own.write_text(short_scenario.read_text() + OWN)
    assert default_policies([str(own)]) == ["scenario"]
    assert "reactive" in default_policies([str(own), str(short_scenario)])
    both = [str(own), str(short_scenario)]
    assert StudyConfig(both, ["planner"], seeds=1).unflown_policies() == [own]
    assert StudyConfig([str(own)], ["scenario"], seeds=1).unflown_policies() == []


def test_own_policy_flies_at_its_own_speed(short_scenario):
    short_scenario.write_text(short_scenario.read_text() + OWN)
    config = StudyConfig([str(short_scenario)], ["scenario"], seeds=1)
    with pytest.raises(ValueError, match=r"flies at 1.5 m/s, its own speed; give --speeds 1.5"):
        config.load_scenarios()
    scenario = replace(config, speeds=[1.5]).load_scenarios()["short"]
    assert (scenario.policy.speed, scenario.policy.margin) == (1.5, 0.4)


def test_all_benchmark_scenarios_load():
    config = StudyConfig()
    assert config.scenarios == list(benchmark_scenarios())
    if config.scenarios:
        assert set(config.load_scenarios()) == set(config.scenarios)
