import os
import subprocess
import sys
from dataclasses import dataclass, field

import pytest
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.systems.sensors import CameraConfig

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import HardwareConfig
from splatpilot.diagrams.worlds.forest.layout import ForestConfig
from splatpilot.diagrams.worlds.outdoor import WallsConfig
from splatpilot.diagrams.worlds.scene_folder import SceneConfig
from splatpilot.diagrams.worlds.world_registry import make_world, register_world
from splatpilot.systems.common.config import (
    describe_fields,
    dump_config,
    load_config,
    parse_config,
    registry_field,
)
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.messaging.receiver import UdpConfig
from splatpilot.systems.policies.reactive import ReactiveConfig


@pytest.fixture
def path(tmp_path):
    return tmp_path / "scenario.yaml"


def test_file_and_overrides_set_only_what_they_name(path):
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
    path.write_text("world: !SceneConfig {path: a}\npolicy: !ReactiveConfig {speed: 1.5}\n")
    scenario = load_config(Scenario(), path, ["world.path=b", "policy.camera.width=32"])
    assert scenario.world == SceneConfig(path="b")
    assert (scenario.policy.speed, scenario.policy.camera.width) == (1.5, 32)


def test_dumped_scenario_loads_as_itself(path):
    scenario = Scenario(seed=7, world=SceneConfig(path="some/where"), start=[1.0, 2.0, 3.0])
    path.write_text(dump_config(scenario))
    assert load_config(Scenario(), path) == scenario
    path.write_text("start: &a [1, 2, 3]\ngoal: *a")
    assert load_config(Scenario(), path).goal == [1, 2, 3]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("wrld.spacing=3", r"'wrld.spacing=3': there is no field wrld; did you mean world"),
        ("policy.lattice.sped=3", r"no field policy.lattice.sped; did you mean policy.lattice.sp"),
        ("speed=3", r"no field speed; did you mean policy.lattice.speed\?"),
        ("camera.lattice=3", r"no field camera.lattice; the fields are camera\."),
        ("qqqqqq=3", r"no field qqqqqq; the fields are .*timeout"),
        ("world=foo", "'world=foo': world must be fields, .* got foo"),
        ("world=null", "'world=null': world must be fields, .* got null"),
        ("sensors={a: null}", "null}': sensors.a must be fields, .* got null"),
        ("start=5", "'start=5': "),
        ("camera.X_PB.translation=[1, 2]", "'camera.X_PB.translation=.1, 2.': "),
        ("timeout=soon", "'timeout=soon': timeout must be a number, got soon"),
        ("seed=1.5", "seed must be a whole number, got 1.5"),
        ("goal=[1, x, 2]", r"goal\[1\] must be a number, got x"),
        ("timeout", "an override must be FIELD=VALUE, got 'timeout'"),
        ("goal=[1, 2", "'goal=.1, 2' is not YAML"),
        ("policy=!AbsentConfig {}", "policy must be one of .*!StraightC.* got !Absent.*--import"),
        ("timeout=0", "timeout .* got 0.0"),
        ("seed=-1", "seed .*2147483647.* got -1"),
        ("goal_radius=-1", "goal_radius .* got -1.0"),
        ("start=[1, 2]", r"start must be three finite numbers .* got \[1.0, 2.0\]"),
        ("goal=[1, .nan, 2]", r"goal must be three finite numbers .* got \[1.0, nan, 2.0\]"),
        ("world.rocks=1000000000", "rocks .* got 1000000000"),
        ("world=!SceneConfig {}", "path must be a scene folder"),
        ("camera.width=0", "camera .* got 0x240 pixels"),
        ("camera.center_x=-1", "principal point must be inside the image"),
        ("camera.fps=1e-9", "camera.fps .* got 1e-09"),
        ("camera.width=1", "camera .* at least 2x2 .* got 1x240"),
        ("camera={width: 4096, height: 4096}", "camera .* at most .* got 4096x4096"),
        ("policy.lattice.speed=1e300", r"^policy\.lattice\.speed .* 20\] m/s, got 1e[+]300"),
        ("world.length=1000000", "length . width must be at most .* got 1.6e[+]07"),
        ("world.voxel_size=1e-9", "voxels .* at most .* use larger voxels"),
        ("world.width=1e-320", "voxels .* at least 2 voxels"),
        ("camera.focal=!FovDegrees {x: null}", "camera.focal .* got neither"),
        ("camera.focal=!FocalLength {x: 0}", "camera.focal must be positive"),
        ("camera.lcm_bus=other", "camera.lcm_bus must be left out, got 'other'"),
        ("simulator.integration_scheme=foo", "integration_scheme .*runge_kutta3.* got foo"),
        ("simulator.max_step_size=0", "max_step_size .* got 0.0"),
        ("simulator.accuracy=0", "accuracy .* got 0.0"),
        ("simulator.start_time=5", "start_time must be 0, got 5.0"),
    ],
)
def test_scenario_refuses_what_cannot_be_read_or_flown(override, message):
    with pytest.raises(ValueError, match=message):
        load_config(Scenario(), overrides=[override]).validate()
    Scenario().validate()


def test_a_word_is_not_read_as_a_list():
    with pytest.raises(ValueError, match=r"senders must be a list, got a; write \[a\]"):
        load_config(UdpConfig(), overrides=["senders=a"])
    assert load_config(UdpConfig(), overrides=["senders=[a]"]).senders == ["a"]


def test_missing_files_are_named(path):
    with pytest.raises(FileNotFoundError, match=r"No such file: .*scenario.yaml"):
        load_config(Scenario(), path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *(
            (text, "a.yaml: the text must be fields")
            for text in (b"", b"# seed: 3\n", b"---\n", b"# x: !Uniform {}\n")
        ),
        (b"timout: 3\n", "a.yaml: there is no field timout; did"),
        (b"timeout: 2\ntimeout: 3", "a.yaml: fields must be given once, got timeout"),
        (b"world: {}\nseed: 1\nworld: {width: 9}", "a.yaml: fields must be given once, got world"),
        (b"start: {0: 1, 1: 2, 2: 3}", r"a.yaml: start must be a list, got \{0: 1"),
        (b"seed: 3\ntimeout: [\n", "a.yaml is not YAML: line 3: expected .*"),
        (b"password\n" * 1000, "a.yaml: the text must be .* got password p"),
        (b"seed: \xff", "a.yaml must be a text .* 0xff at byte 6"),
        (b"start: " + b"[" * 1000 + b"]" * 1000, "a.yaml is not YAML: .* nested too deeply"),
        (b"start: &a [1, *a]", r"a.yaml: start\[1\] must be a number, got \[1"),
        (b"moving: {a: &m {radius: !Uniform {min: 1, max: 2}}, b: *m}", r"without \*, got \*"),
        (None, "a.yaml must have at most 64 MB, got 100 MB"),
    ],
)
def test_a_bad_file_is_named_and_not_repeated(tmp_path, content, message):
    path = tmp_path / "a.yaml"
    path.write_bytes(content or b"")
    if content is None:
        os.truncate(path, 100_000_000)
    with pytest.raises(ValueError, match=message) as caught:
        load_config(Scenario(), path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200 + len(str(path))


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


def test_registry_fields_are_read_and_written_as_drake_does():
    text = "policy: !ReactiveConfig {margin: 0.3}\nworld: !WallsConfig {pattern: slalom}"
    scenario = yaml_load_typed(schema=Scenario, data=text)
    assert scenario.policy == ReactiveConfig(margin=0.3)
    assert scenario.world == WallsConfig(pattern="slalom")
    assert yaml_dump_typed(scenario) == dump_config(scenario)
    assert yaml_load_typed(schema=Scenario, data=yaml_dump_typed(scenario)) == scenario
    changed = load_config(scenario, overrides=["policy.rate=9"]).policy
    assert changed == ReactiveConfig(margin=0.3, rate=9)


def test_tags_are_known_in_a_new_process_that_imports_the_package_alone():
    text = "policy: !ReactiveConfig {}\nworld: !WallsConfig {}"
    read = "from pydrake.common.yaml import yaml_load_typed as load; import splatpilot as sp"
    program = f"{read}; load(schema=sp.Scenario, data={text!r})"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_override_creates_and_removes_a_configuration():
    config = load_config(HardwareConfig(), overrides=["time_of_flight.latency=0.1"])
    assert config.time_of_flight is not None and config.time_of_flight.latency == 0.1
    assert load_config(config, overrides=["time_of_flight=null"]).time_of_flight is None
    sensors = ["sensors={down: !OnboardCamera {width: 20}}", "sensors.down.height=10"]
    camera = load_config(Scenario(), overrides=sensors).sensors["down"]
    assert (camera.width, camera.height) == (20, 10)


ENGINES = Registry("engine", "tests.engines", object)


@dataclass
class Wheel:
    """A part
    that rolls.

    More of it."""

    # [m]
    radius: float = 0.3


@dataclass
class Vehicle:
    # Above,
    # on two lines.
    mass: float = 1.0
    name: str = "größe # nothing"  # After: of it.
    wheel: Wheel = field(default_factory=Wheel)
    """Below,
    on two lines."""

    # A heading.

    bare: int = 0
    spare: Wheel = field(default_factory=Wheel)
    engine: Wheel = registry_field(ENGINES, Wheel)  # [-] Of any kind.


@dataclass
class Car(Vehicle):
    mass: float = 900.0
    """[kg] Of the car."""
    doors: int = 4


def test_comments_and_strings_describe_fields():
    fields = describe_fields(Vehicle())
    assert {field.name: field.text for field in fields} == {
        "mass": "Above, on two lines.",
        "name": "After: of it.",
        "wheel": "Below, on two lines.",
        "bare": "",
        "spare": "A part that rolls.",
        "engine": "[-] Of any kind.",
    }
    assert {field.name: field.registry for field in fields if field.registry} == {"engine": ENGINES}


def test_a_class_without_source_describes_inherited_fields():
    names = {"dataclass": dataclass, "Car": Car, "__name__": "a_session"}
    exec("@dataclass\nclass Taxi(Car):\n    fare: float = 2.0", names)
    fields = describe_fields(names["Taxi"](doors=2))
    assert [(f.name, f.value) for f in fields[:2]] == [("mass", 900.0), ("name", "größe # nothing")]
    assert [f.text for f in fields[:2]] == ["[kg] Of the car.", "After: of it."]
    assert [(f.name, f.value, f.text) for f in fields[-2:]] == [("doors", 2, ""), ("fare", 2.0, "")]


def test_docstrings_of_drake_describe_its_fields():
    texts = {field.name: field.text for field in describe_fields(CameraConfig())}
    assert texts["width"] == "Image width (in pixels)."


@pytest.mark.parametrize("value", [1, "text", None, [1.0], {}])
def test_plain_values_have_no_fields(value):
    assert describe_fields(value) == []
