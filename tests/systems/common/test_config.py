import subprocess
import sys
from dataclasses import dataclass

import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import HardwareConfig
from splatpilot.diagrams.worlds.forest.layout import ForestConfig
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.diagrams.worlds.world_registry import make_world, register_world
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.training.corpus.library import LibraryConfig


def test_file_and_overrides_set_only_what_they_name(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text("timeout: 9\nworld: {spacing: 2.5}\npolicy: {lattice: {speed: 3.0}}\n")
    scenario = load_config(
        Scenario(seed=4), path, ["policy.lattice.speed=4", "goal=[1, 2, 3]", "camera.fps=30"]
    )
    assert (scenario.seed, scenario.timeout, scenario.world.spacing) == (4, 9.0, 2.5)
    assert scenario.world.width == Scenario().world.width
    assert scenario.policy.lattice.speed == 4.0
    assert scenario.policy.rate == Scenario().policy.rate
    assert scenario.goal == [1.0, 2.0, 3.0]
    assert (scenario.camera.fps, scenario.camera.width) == (30.0, 320)


def test_dumped_scenario_loads_as_itself(tmp_path):
    scenario = Scenario(seed=7, world=SceneConfig(path="some/where"), start=[1.0, 2.0, 3.0])
    path = tmp_path / "scenario.yaml"
    path.write_text(dump_config(scenario))
    loaded = load_config(Scenario(), path)
    assert loaded.world == scenario.world
    assert dump_config(loaded) == dump_config(scenario)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("wrld.spacing=3", r"'wrld.spacing=3': there is no field wrld; did you mean world"),
        ("policy.lattice.sped=3", r"no field policy.lattice.sped; did you mean policy.lattice.sp"),
        ("policy.speed=3", r"no field policy.speed; .*policy.lattice"),
        ("camera.fpss=3", r"no field camera.fpss; did you mean camera.fps"),
        ("speed=3", r"no field speed; did you mean policy.lattice.speed\?"),
        ("camera.lattice=3", r"no field camera.lattice; the fields are camera\."),
        ("qqqqqq=3", r"no field qqqqqq; the fields are .*timeout"),
        ("policy=3", "'policy=3': policy must be fields, NAME: VALUE each, got 3"),
        ("world=foo", "'world=foo': world must be fields, .* got foo"),
        ("camera=null", "'camera=null': camera must be fields, .* got null"),
        ("world=null", "'world=null': world must be fields, .* got null"),
        ("policy=null", "'policy=null': policy must be fields, .* got null"),
        ("sensors=null", "'sensors=null': sensors must be fields, .* got null"),
        ("sensors={a: null}", "null}': sensors.a must be fields, .* got null"),
        ("start=5", "'start=5': "),
        ("camera.X_PB.translation=[1, 2]", "'camera.X_PB.translation=.1, 2.': "),
        ("timeout=soon", "'timeout=soon': timeout must be a number, got soon"),
        ("seed=1.5", "seed must be a whole number, got 1.5"),
        ("goal=[1, x, 2]", r"goal\[1\] must be a number, got x"),
        ("timeout", "an override must be FIELD=VALUE, got 'timeout'"),
        ("goal=[1, 2", "'goal=.1, 2' is not YAML"),
    ],
)
def test_bad_override_is_named(override, message):
    with pytest.raises(ValueError, match=message):
        load_config(Scenario(), overrides=[override])


def test_a_word_is_not_read_as_a_list():
    with pytest.raises(ValueError, match=r"kinds must be a list, got P02; write \[P02\]"):
        load_config(LibraryConfig(), overrides=["kinds=P02"])
    assert load_config(LibraryConfig(), overrides=["kinds=[P02]"]).kinds == ["P02"]


def test_first_override_in_a_process_keeps_the_type_of_its_configuration():
    program = (
        "from splatpilot.diagrams.flight.scenario import Scenario\n"
        "from splatpilot.systems.common.config import load_config\n"
        "from splatpilot.systems.policies.reactive import ReactiveConfig\n"
        "scenario = Scenario(policy=ReactiveConfig())\n"
        "config = load_config(scenario, overrides=['policy.rate=9', 'policy.margin=0.3']).policy\n"
        "assert isinstance(config, ReactiveConfig), config\n"
        "assert (config.rate, config.margin) == (9, 0.3), config\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_bad_file_is_named(tmp_path):
    path = tmp_path / "scenario.yaml"
    with pytest.raises(FileNotFoundError, match=r"No such file: .*scenario.yaml"):
        load_config(Scenario(), path)
    path.write_text("timout: 3\n")
    with pytest.raises(ValueError, match=r"scenario.yaml: there is no field timout; did"):
        load_config(Scenario(), path)
    path.write_text("seed: 3\ntimeout: [\n")
    with pytest.raises(
        ValueError, match=r"scenario.yaml is not YAML: line 3: expected .*"
    ) as caught:
        load_config(Scenario(), path)
    assert "\n" not in str(caught.value)
    for empty in ("", "# seed: 3\n", "---\n"):
        path.write_text(empty)
        with pytest.raises(ValueError, match=r"scenario.yaml: the text must be fields"):
            load_config(Scenario(), path)


def test_files_are_not_repeated_in_errors(tmp_path):
    path = tmp_path / "secret.yaml"
    path.write_text("password\n" * 1000)
    with pytest.raises(
        ValueError, match=r"secret.yaml: the text must be .* got password p"
    ) as caught:
        load_config(Scenario(), path)
    assert len(str(caught.value)) < 200 + len(str(path))
    path.write_bytes(b"seed: \xff")
    with pytest.raises(ValueError, match=r"secret.yaml must be a text .* 0xff at byte 6"):
        load_config(Scenario(), path)
    path.write_text("start: " + "[" * 5000 + "]" * 5000)
    with pytest.raises(ValueError, match=r"secret.yaml is not YAML: .* nested too deeply"):
        load_config(Scenario(), path)
    path.write_text("start: &a [1, *a]")
    with pytest.raises(ValueError, match=r"secret.yaml: start\[1\] must be a number, got \[1"):
        load_config(Scenario(), path)
    path.write_text("start: &a [1, 2, 3]\ngoal: *a")
    assert load_config(Scenario(), path).goal == [1, 2, 3]
    with path.open("wb") as file:
        file.truncate(100_000_000)
    with pytest.raises(ValueError, match=r"secret.yaml must have at most 64 MB, got 100 MB"):
        load_config(Scenario(), path)


def test_fields_that_may_be_empty_may_be_null(tmp_path):
    config = load_config(HardwareConfig(), overrides=["time_of_flight={latency: 0.1}"])
    assert config.time_of_flight is not None and config.time_of_flight.latency == 0.1
    assert load_config(config, overrides=["time_of_flight=null"]).time_of_flight is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("timeout=0", "timeout .* got 0.0"),
        ("seed=-1", "seed .*2147483647.* got -1"),
        ("seed=9999999999999999999999", "seed .*2147483647.* got 9999999999999999999999"),
        ("goal_radius=-1", "goal_radius .* got -1.0"),
        ("start_radius=.inf", "start_radius .* got inf"),
        ("start=[1, 2]", r"start must be three finite numbers .* got \[1.0, 2.0\]"),
        ("goal=[1, .nan, 2]", r"goal must be three finite numbers .* got \[1.0, nan, 2.0\]"),
        ("world.rocks=1000000000", "rocks .* got 1000000000"),
        ("world=!SceneConfig {}", "path must be a scene folder"),
        ("camera.width=0", "camera .* got 0x240 pixels"),
        ("camera.width=1000000", "camera .* got 1000000x240 pixels"),
        ("camera.center_x=-1", "principal point must be inside the image"),
        ("camera.fps=1e-9", "camera.fps .* got 1e-09"),
        ("camera.width=1", "camera .* at least 2x2 .* got 1x240"),
        ("camera={width: 4096, height: 4096}", "camera .* at most .* got 4096x4096"),
        ("policy.lattice.speed=1e300", r"^policy\.lattice\.speed .* 20\] m/s, got 1e[+]300"),
        ("world.length=1000000", "length . width must be at most .* got 1.6e[+]07"),
        ("world.width=1e9", "length . width must be at most .* got 3.6e[+]10"),
        ("world.voxel_size=1e-9", "voxels .* at most .* use larger voxels"),
        ("world.width=1e-320", "voxels .* at least 2 voxels"),
        ("camera.focal=!FovDegrees {x: null}", "camera.focal .* got neither"),
        ("camera.fps=.inf", "camera.fps .* got inf"),
        ("camera.focal=!FocalLength {x: 0}", "camera.focal must be positive"),
        ("camera.lcm_bus=other", "camera.lcm_bus must be left out, got 'other'"),
        ("simulator.integration_scheme=foo", "integration_scheme .*runge_kutta3.* got foo"),
        ("simulator.max_step_size=0", "max_step_size .* got 0.0"),
        ("simulator.max_step_size=.nan", "max_step_size .* got nan"),
        ("simulator.accuracy=0", "accuracy .* got 0.0"),
        ("simulator.start_time=5", "start_time must be 0, got 5.0"),
    ],
)
def test_scenario_refuses_what_cannot_be_flown(override, message):
    with pytest.raises(ValueError, match=message):
        load_config(Scenario(), overrides=[override]).validate()


def test_defaults_are_valid_and_checked(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text("seed: 0\n")
    scenario = load_config(Scenario(), path)
    assert dump_config(scenario) == dump_config(Scenario())
    scenario.validate()
    scenario.timeout = 0.0
    with pytest.raises(ValueError, match=r"timeout .* got 0"):
        scenario.validate()


def test_override_keeps_the_type_that_a_file_chose(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text("world: !SceneConfig {path: a}\npolicy: !ReactiveConfig {speed: 1.5}\n")
    overrides = ["world.path=b", "policy.camera.width=32"]
    scenario = load_config(Scenario(), path, overrides)
    assert scenario.world == SceneConfig(path="b")
    assert (scenario.policy.speed, scenario.policy.camera.width) == (1.5, 32)


def test_unknown_type_is_refused_with_the_known_ones():
    with pytest.raises(
        ValueError,
        match=r"policy must be one of .*!StraightC.* got !Absent.*--import",
    ):
        load_config(Scenario(), overrides=["policy=!AbsentConfig {}"])


def test_type_of_another_package_is_read_and_written():

    @dataclass
    class DerivedForestConfig(ForestConfig):
        gap: float = 1.0

    register_world(DerivedForestConfig, make=make_world)
    scenario = parse_config(
        Scenario(), "world: !DerivedForestConfig {gap: 2, spacing: 2.5}", "text"
    )
    assert scenario.world == DerivedForestConfig(gap=2.0, spacing=2.5)
    text = dump_config(scenario)
    assert "world: !DerivedForestConfig" in text
    assert parse_config(Scenario(), text, "dump").world == scenario.world
    assert "!ForestConfig" not in dump_config(Scenario())


def test_drakes_functions_read_and_write_registry_fields():
    program = (
        "from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed\n"
        "import splatpilot as sp\n"
        "text = 'policy: !ReactiveConfig {margin: 0.3}\\nworld: !WallsConfig {pattern: slalom}'\n"
        "scenario = yaml_load_typed(schema=sp.Scenario, data=text)\n"
        "policy, world = scenario.policy, scenario.world\n"
        "assert (type(policy).__name__, policy.margin) == ('ReactiveConfig', 0.3), scenario\n"
        "assert (type(world).__name__, world.pattern) == ('WallsConfig', 'slalom'), scenario\n"
        "assert yaml_dump_typed(scenario) == sp.dump_config(scenario)\n"
        "again = yaml_load_typed(schema=sp.Scenario, data=yaml_dump_typed(scenario))\n"
        "assert (again.policy, again.world) == (scenario.policy, scenario.world)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_override_creates_an_absent_configuration():
    config = load_config(HardwareConfig(), overrides=["time_of_flight.latency=0.1"])
    assert config.time_of_flight is not None and config.time_of_flight.latency == 0.1
    sensors = ["sensors={down: !OnboardCamera {width: 20}}", "sensors.down.height=10"]
    camera = load_config(Scenario(), overrides=sensors).sensors["down"]
    assert (camera.width, camera.height) == (20, 10)
