"""Finding scenarios by name or path, and writing them."""

import pytest
from pydrake.common.schema import Uniform

from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.diagrams.scenarios import (
    benchmark_scenarios,
    other_scenarios,
    profiles,
    scenario_file,
)
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.systems.vehicle.vehicles import Kingfisher


def test_names_and_paths_are_found(tmp_path):
    assert scenario_file("P01") == benchmark_scenarios()["P01"]
    assert scenario_file("P01").is_file() and scenario_file("alley_splat").is_file()
    other = tmp_path / "other"
    other.write_text("")
    assert scenario_file(str(other)) == other
    assert scenario_file("mine.yaml").name == "mine.yaml"
    with pytest.raises(ValueError, match=r"no scenario 'nothing'.*P01, P02"):
        scenario_file("nothing")
    numbered = [*(f"P{k:02d}" for k in range(1, 13)), *(f"R{k}" for k in range(13, 18))]
    assert sorted(benchmark_scenarios()) == numbered
    assert not set(benchmark_scenarios()) & set(other_scenarios())


@pytest.mark.parametrize("name", benchmark_scenarios() | other_scenarios())
def test_scenario_that_was_written_is_the_same(name):
    scenario = load_config(Scenario(), scenario_file(name))
    scenario.validate()
    again = parse_config(Scenario(), dump_config(scenario), name)
    assert type(again.world) is type(scenario.world)
    assert again.world == scenario.world


def loaded(*overrides: str, **fields) -> Scenario:
    return load_config(Scenario(**fields), overrides=overrides)


def test_a_profile_sets_its_fields_and_keeps_the_others():
    overrides = "vehicle.drag=!Uniform {min: 0.3, max: 0.5}", "timeout=9", "profile=realistic"
    scenario = loaded(*overrides, "observation.latency=0")
    assert scenario.timeout == 9 and scenario.observation.latency == 0
    assert 0.3 < sample_scenario(scenario).vehicle.drag < 0.5
    drawn = [sample_scenario(loaded("profile=harsh", f"seed={k}")).imaging for k in (1, 2)]
    assert drawn[0].focal_scale != drawn[1].focal_scale
    assert drawn[0].stereo == drawn[1].stereo != scenario.imaging.stereo
    again = parse_config(Scenario(), dump_config(scenario), "again")
    assert again == scenario


def test_a_vehicle_is_chosen_by_its_tag_and_written_with_it():
    scenario = loaded("vehicle=!Kingfisher {model: lags}")
    assert scenario.vehicle == Kingfisher(model="lags")
    assert "vehicle: !Kingfisher" in dump_config(scenario)
    assert load_config(scenario, overrides=["vehicle.mass=0.8"]).vehicle.mass == 0.8
    assert "!QuadrotorParams" not in dump_config(Scenario())


def test_a_profile_may_be_a_file_and_keeps_the_type_of_the_vehicle(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "vehicle: {thrust_scale: 0.9, drag: !Uniform {min: 0.3, max: 0.5}}\n"
        "estimator: !MotionCapture {rate: 200}\n"
    )
    scenario = loaded("vehicle=!Kingfisher {mass: 0.8}", f"profile={file}")
    drag = scenario.vehicle.drag
    assert scenario.vehicle == Kingfisher(mass=0.8, thrust_scale=0.9, drag=drag)
    assert isinstance(drag, Uniform) and scenario.estimator.rate == 200
    for text, profile, message in (
        ("[1, 2]\n", file, r"mine.yaml must be fields, NAME: VALUE each"),
        ("estimators: {}\n", file, r"mine.yaml: there is no field estimators; did you mean"),
        ("", "real", r"no profile 'real'.*realistic"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            loaded(f"profile={profile}")


@pytest.mark.parametrize("name", profiles())
@pytest.mark.parametrize("policy", ["planner", "diffaero", "diffaero_tof", "diffaero_rgb"])
def test_profiles_are_valid_for_every_seed(name, policy):
    for seed in range(4):
        loaded(f"profile={name}", f"seed={seed}", policy=policy_named(policy)).validate()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["estimator=!VisualInertial {rate: 10}"],
            r"estimator\.rate must be at least 15 Hz, got 10.*; a policy needs",
        ),
        (
            ["imaging.exposure_time=0.08"],
            r"imaging\.exposure_time must be at most 0\.06667 s, .*, got 0\.08; shorten it",
        ),
        (
            ["imaging.exposure_time=0.04", "observation.frame_rate=[20, 30]"],
            r"exposure_time must be at most 0\.03333 s",
        ),
        (
            ["vehicle.rate_time_constant=0.004"],
            r"shortest time constant .* at least half of .*0.02 s.*, got 0.004 s; set .* 0.008",
        ),
        (["decision_delay=[0.1, 0.05]"], r"decision_delay must be two numbers in ascending"),
        (["decision_delay=[0.0, 2.0]"], r"decision_delay must be in \[0, 1\] s"),
        (["camera.output_delay=2"], r"camera\.output_delay must be"),
        (["camera.capture_offset=0.1"], r"camera\.capture_offset must be"),
        (["imaging.stereo={baseline: 0}"], r"imaging\.stereo\.baseline must be in \(0, 1\] m"),
    ],
)
def test_times_that_do_not_fit_are_named(overrides, message):
    with pytest.raises(ValueError, match=message):
        loaded(*overrides, policy=policy_named("diffaero")).validate()
