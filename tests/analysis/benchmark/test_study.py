from dataclasses import replace

import pytest

from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig, default_policies
from splatpilot.analysis.benchmark.variants import Variant, parse_variant, split_policies, sweep
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.policies.reactive import ReactiveConfig

OWN = "policy: !ReactiveConfig {speed: 1.5, margin: 0.4}\n"


def test_rollouts_are_all_combinations(short_scenario):
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    specs = config.rollouts()
    assert len(specs) == len(set(specs)) == len({spec.id for spec in specs}) == 12
    assert {spec.scenario for spec in specs} == {"short"}
    assert RolloutSpec("short", "straight", 1.5, 2) in specs
    assert RolloutSpec("P02", "planner", 2.0, 7).id == "P02-planner-2-007"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenarios": ["P99"]}, "there is no scenario 'P99'"),
        ({"scenarios": []}, "the study has no scenario"),
        ({"policies": ["plan"]}, r"there is no policy 'plan'; did you mean planner"),
        ({"policies": ["planner", "planner"]}, "the policy planner is given twice"),
        ({"policies": ["reactive:margn=0.2"]}, "policy reactive-margn-0.2: .*did you mean margin"),
        ({"policies": ["straight:rate=-1"]}, "straight-rate--1: StraightConfig.rate .* got -1"),
        ({"policies": ["scenario"]}, "short.yaml has no `policy`, which --policies scenario would"),
        ({"speeds": [2.0, 2.0000001]}, "the speed 2 is given twice"),
        ({"speeds": [-1.0]}, "speeds .* 20] m/s, got -1"),
        ({"seeds": 0}, r"seeds of split dev must be in \[1, 100\], got 0"),
        ({"seeds": 101}, r"seeds of split dev must be in \[1, 100\], got 101"),
        ({"split": "fresh"}, "split must be one of dev, test, got 'fresh'"),
        ({"overrides": ["world.spacing=0.1"]}, "scenario short: .*spacing"),
        ({"overrides": ["policy.rate=3"]}, "write --policies NAME:rate=3"),
        ({"overrides": ["seed=3"]}, "give their number with --seeds"),
        ({"overrides": ["wrld.spacing=1"]}, "did you mean world"),
    ],
)
def test_invalid_studies_are_refused(short_study, changes, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        replace(short_study, **changes).load_scenarios()


def test_flights_of_one_name_are_refused(short_scenario):
    other = short_scenario.with_name("short-a.yaml")
    other.write_text(short_scenario.read_text())
    config = StudyConfig([str(short_scenario), str(other)], ["a-b=planner", "b=planner"], seeds=1)
    with pytest.raises(ValueError, match="the flight short-a-b-2-000 is given twice"):
        config.load_scenarios()


def test_own_policies_of_scenarios_are_the_default(short_scenario):
    own = short_scenario.with_name("own.yaml")
    own.write_text(short_scenario.read_text() + OWN)
    both = [str(own), str(short_scenario)]
    assert default_policies([str(own)]) == ["scenario"]
    assert "reactive" in default_policies(both)
    assert StudyConfig(both, ["planner"], seeds=1).unflown_policies() == [own]
    assert StudyConfig([str(own)], ["scenario"], seeds=1).unflown_policies() == []


def test_own_policy_flies_at_its_own_speed(short_scenario):
    short_scenario.write_text(short_scenario.read_text() + OWN)
    config = StudyConfig([str(short_scenario)], ["scenario"], seeds=1)
    with pytest.raises(ValueError, match=r"at 1.5 m/s, its own speed; give --speeds 1.5"):
        config.load_scenarios()
    scenario = replace(config, speeds=[1.5]).load_scenarios()["short"]
    assert (scenario.policy.speed, scenario.policy.margin) == (1.5, 0.4)


def test_all_benchmark_scenarios_load():
    config = StudyConfig()
    assert set(config.load_scenarios()) == set(config.scenarios) == set(benchmark_scenarios())


@pytest.mark.parametrize(
    ("text", "variant"),
    [
        ("reactive", Variant("reactive", "reactive")),
        ("fast=reactive", Variant("fast", "reactive")),
        ("reactive:margin=0.2", Variant("reactive-margin-0.2", "reactive", ("margin=0.2",))),
        (
            "planner:lattice.jerk=1:rate=10",
            Variant("planner-lattice.jerk-1-rate-10", "planner", ("lattice.jerk=1", "rate=10")),
        ),
        ("out/mine.npz", Variant("mine", "out/mine.npz")),
        ("a=out/x=y:z/m.npz:rate=3", Variant("a", "out/x=y:z/m.npz", ("rate=3",))),
        ("m=others:Mine:gain=2", Variant("m", "others:Mine", ("gain=2",))),
        ("r=reactive:camera={width: 32}", Variant("r", "reactive", ("camera={width: 32}",))),
    ],
)
def test_variants_are_parsed(text, variant):
    assert parse_variant(text) == variant


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a/b=reactive", "labeled 'a/b', but labels name files"),
        ("=reactive", "'=reactive' has no label before its ="),
        ("reactive:yaws=[1, 2]", r"LABEL=POLICY"),
        ("x" * 81 + "=reactive", "at most 80"),
        ("a=reactive:speed=3", "must not set speed; give the speed of all policies"),
        ("../mine.py", r"a policy must be .*, got \.\./mine\.py; .* write mine:CLASS"),
    ],
)
def test_invalid_variants_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_variant(text)


def test_variant_changes_the_named_fields():
    config = parse_variant("wide=reactive:margin=0.4:camera.width=32").config(1.5, None)
    assert isinstance(config, ReactiveConfig)
    assert (config.speed, config.margin, config.camera.width) == (1.5, 0.4, 32)
    assert config.camera.height == ReactiveConfig().camera.height
    own = ReactiveConfig(margin=0.1, speed=3.0)
    assert parse_variant("scenario").config(2.0, own) == own
    assert parse_variant("o=scenario:margin=0.3").config(2.0, own).margin == 0.3
    assert own.margin == 0.1


def test_lists_are_split_outside_brackets():
    parts = split_policies("a, b=c:x=[1,2]:y={z: 1,w: 2},d")
    assert parts == ["a", "b=c:x=[1,2]:y={z: 1,w: 2}", "d"]


def test_sweep_is_all_combinations():
    assert list(sweep("reactive:margin=0.1,0.2")) == ["reactive:margin=0.1", "reactive:margin=0.2"]
    labels = [parse_variant(text).label for text in sweep("planner:rate=5,10:lattice.k=1,2,3")]
    assert len(set(labels)) == 6
    assert labels[4] == "planner-rate-10-lattice.k-2"
    with pytest.raises(ValueError, match="has no field"):
        list(sweep("reactive"))
