import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from pydrake.common.schema import Uniform, UniformVectorX

from splatpilot.analysis.benchmark.study import (
    RolloutSpec,
    StudyConfig,
    default_policies,
    own_speeds,
    parameter_rows,
    policy_texts,
    scenario_texts,
)
from splatpilot.analysis.benchmark.variants import (
    ScenarioVariant,
    Variant,
    parse_scenario,
    parse_variant,
    split_policies,
    sweep,
)
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.policies.reactive import ReactiveConfig


def test_rollouts_are_all_combinations(short_study):
    specs = replace(short_study, speeds=[1.5, 2.0]).rollouts()
    assert len(specs) == len({spec.id for spec in specs}) == 12
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


def test_flights_of_one_name_are_refused(short_study, short_scenario):
    other = shutil.copy(short_scenario, short_scenario.with_name("short-a.yaml"))
    scenarios, policies = [str(short_scenario), str(other)], ["a-b=planner", "b=planner"]
    with pytest.raises(ValueError, match="the flight short-a-b-2-000 is given twice"):
        replace(short_study, scenarios=scenarios, policies=policies).load_scenarios()


def test_own_policies_of_scenarios_are_the_default_and_fly_at_their_speed(short_scenario):
    own = short_scenario.with_name("own.yaml")
    own.write_text(short_scenario.read_text() + "policy: !ReactiveConfig {speed: 1.5}\n")
    both = [str(own), str(short_scenario)]
    assert default_policies([str(own)]) == ["scenario"]
    assert "reactive" in default_policies(both)
    assert StudyConfig(both, ["planner"], seeds=1).unflown_policies() == [own]
    config = StudyConfig([str(own)], ["scenario"], seeds=1)
    assert config.unflown_policies() == []
    with pytest.raises(ValueError, match=r"at 1.5 m/s, its own speed; give --speeds 1.5"):
        config.load_scenarios()
    assert replace(config, speeds=[1.5]).load_scenarios()["own"].policy.speed == 1.5
    assert own_speeds(config) == [1.5] and own_speeds(StudyConfig(both, ["planner"])) == []


def test_all_benchmark_scenarios_load():
    config = StudyConfig()
    assert set(config.load_scenarios()) == set(config.scenarios) == set(benchmark_scenarios())


@pytest.mark.parametrize(
    ("text", "variant"),
    [
        ("reactive", Variant("reactive", "reactive")),
        ("fast=reactive", Variant("fast", "reactive")),
        ("planner:k.j=1:rate=2", Variant("planner-k.j-1-rate-2", "planner", ("k.j=1", "rate=2"))),
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
    labels = [parse_variant(text).label for text in sweep("planner:rate=5,10:lattice.k=1,2,3")]
    assert len(set(labels)) == 6
    assert labels[4] == "planner-rate-10-lattice.k-2"
    with pytest.raises(ValueError, match="has no field"):
        list(sweep("reactive"))


def test_tables_grids_and_distributions_are_rows():
    table = pd.DataFrame({"vehicle.drag": [0.3, 0.5], "timeout": [2.0, np.nan]})
    rows = [{"vehicle.drag": 0.3, "timeout": 2.0}, {"vehicle.drag": 0.5}]
    assert parameter_rows(table) == parameter_rows(table.to_dict("records")) == rows
    assert parameter_rows(None) == [{}]
    drag = Uniform(min=0.3, max=0.5)
    grid = {"vehicle.drag": drag, "timeout": [2, 3], "goal_radius": np.array([0.5])}
    assert [row["timeout"] for row in parameter_rows(grid)] == [2, 3]
    assert all(row["vehicle.drag"] is drag for row in parameter_rows(grid))
    drawn = parameter_rows(grid := {"vehicle.drag": drag, "goal": UniformVectorX([1], [2])}, 3)
    assert len({row["vehicle.drag"] for row in drawn}) == len(drawn) == 3
    assert drawn[:2] == parameter_rows(grid, 2)
    row = {"goal": np.ones(3), "vehicle.drag": drag, "timeout": np.int64(3)}
    texts = ["P02:goal=[1.0, 1.0, 1.0]:vehicle.drag=!Uniform {min: 0.3, max: 0.5}:timeout=3"]
    assert scenario_texts(["P02"], [row]) == texts


def test_scenarios_are_parsed_with_their_fields():
    short, label = "P02:world.spacing=2:policy.rate=5", "P02-world.spacing-2-policy.rate-5"
    expected = ScenarioVariant(label, "P02", ("world.spacing=2",), ("rate=5",))
    assert parse_scenario(short) == expected
    assert expected.fields == ["world.spacing", "policy.rate"]
    named = "dense=out/a.yaml:goal=[1,2,3]"
    assert parse_scenario(named) == ScenarioVariant("dense", "out/a.yaml", ("goal=[1,2,3]",))
    assert parse_scenario("out/x=y/a.yaml").label == "a"
    assert parse_scenario("P02:goal=[1,2,3]").label.startswith("P02-")


def test_configurations_of_policies_become_texts():
    def climb(scenario, world):
        raise NotImplementedError

    config = ReactiveConfig(margin=0.3, speed=3.0)
    config.camera.width = 32
    texts, systems, speeds = policy_texts(["planner", config, climb])
    assert texts[0] == "planner" and texts[2] == "climb=live" and speeds == [3.0]
    assert parse_variant(texts[1]).config(3.0, None) == config
    assert systems == {"climb": climb}
    labeled = {"up": climb, "r": "reactive:margin=0.2"}
    assert policy_texts(labeled)[0] == ["up=live", "r=reactive:margin=0.2"]
    with pytest.raises(ValueError, match=r"a policy must be named, got <lambda>; .*LABEL"):
        policy_texts(lambda scenario, world: climb)
