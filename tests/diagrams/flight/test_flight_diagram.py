"""Diagrams of finished systems, and of sensors."""

import dataclasses

import numpy as np
import pytest
from pydrake.common.schema import Rotation, Transform
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.diagrams.flight.flight import Outcome, fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import POLICIES, policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds.world_registry import WORLDS, make_world
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant


def flown(scenario: Scenario, world, **systems):
    return fly(BuildFlightDiagram(scenario, world, camera=False, **systems), scenario, world)


def test_finished_systems_fly_as_configured_ones(post_world):
    scenario = Scenario(timeout=1.5, policy=policy_named("reactive"))
    configured = flown(scenario, post_world)
    given = flown(
        scenario,
        post_world,
        policy=Reactive(scenario.policy),
        plant=QuadrotorPlant(scenario.vehicle),
        controller=FlatnessController(scenario.controller, scenario.vehicle),
    )
    np.testing.assert_array_equal(given.states, configured.states)
    # Without a configuration that says how, the policy looks through the default camera.
    scenario.policy = policy_named("planner")
    np.testing.assert_array_equal(
        flown(scenario, post_world, policy=Reactive()).states[-1], configured.states[-1]
    )


def test_a_policy_needs_only_its_outputs(post_world):
    scenario = Scenario(timeout=8.0, start_radius=0.0, start=[1, 0, 2], goal=[3.0, 0, 2])

    class Waypoint(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorOutputPort("waypoint", 3, lambda _, y: y.SetFromVector([3.0, 0, 2]))

    flight = flown(scenario, post_world, policy=Waypoint())
    assert flight.outcome in (Outcome.GOAL, Outcome.TIMEOUT)
    assert np.linalg.norm(flight.states[-1, :3] - [3.0, 0, 2]) < 0.3


def test_appearance_changes_colors_and_no_flight(post_world):

    def seen(**fields):
        diagram = BuildFlightDiagram(Scenario(timeout=0.5, **fields), post_world)
        context = diagram.CreateDefaultContext()
        return [
            np.array(diagram.GetOutputPort(name).Eval(context).data)
            for name in ("color_image", "depth_image_32f")
        ]

    plain, other, again = seen(), seen(appearance=1.0), seen(appearance=1.0)
    difference = np.abs(plain[0][..., :3].astype(int) - other[0][..., :3])
    assert difference.mean() > 5.0
    np.testing.assert_array_equal(other[0], again[0])
    np.testing.assert_array_equal(plain[1], other[1])
    flights = [flown(Scenario(timeout=0.5, appearance=x), post_world) for x in (0.0, 1.0)]
    np.testing.assert_array_equal(flights[0].states, flights[1].states)


def test_systems_without_the_ports_they_need_are_named(post_world):
    scenario = Scenario(timeout=1.0)
    with pytest.raises(ValueError, match=r"policy ConstantVectorSource.* has none of the outputs"):
        flown(scenario, post_world, policy=ConstantVectorSource(np.zeros(3)))
    with pytest.raises(ValueError, match=r"the plant ConstantVector.* has no port 'command'"):
        flown(scenario, post_world, plant=ConstantVectorSource(np.zeros(13)))

    class Listener(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("wind", 3)
            self.DeclareVectorOutputPort("waypoint", 3, lambda _, y: None)

    with pytest.raises(ValueError, match=r"nothing gives the input 'wind' of the policy Listener"):
        flown(scenario, post_world, policy=Listener())


def test_ports_of_another_size_are_named(post_world):

    class Policy(LeafSystem):
        def __init__(self, output: str, size: int, goal: int = 3):
            super().__init__()
            self.DeclareVectorInputPort("goal", goal)
            self.DeclareVectorOutputPort(output, size, lambda _, y: None)

    for policy, message in (
        (
            Policy("waypoint", 4),
            r"'waypoint' of .* \(a vector of 3\) must .* of Policy \(a vector of 4\)",
        ),
        (
            Policy("velocity", 1),
            r"input 'velocity' of .* must .* 'velocity' of Policy \(a vector of 1\)",
        ),
        (Policy("waypoint", 3, goal=2), r"the input 'goal' of Policy \(a vector of 2\) must"),
    ):
        with pytest.raises(ValueError, match=message):
            flown(Scenario(timeout=1.0), post_world, policy=policy)

    class Painter(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("color_image", 3)
            self.DeclareVectorOutputPort("waypoint", 3, lambda _, y: None)
            self.camera = OnboardCamera()

    with pytest.raises(ValueError, match=r"'color_image' of SplatCamera \(not a vector\)"):
        flown(Scenario(timeout=1.0), post_world, policy=Painter())


def test_scenarios_out_of_range_are_refused(post_world):
    for wrong, message in (
        ({"timeout": -1.0}, "timeout .* got -1.0"),
        ({"timeout": np.nan}, "timeout .* got nan"),
        ({"goal_radius": -1.0}, "goal_radius .* got -1.0"),
        ({"goal": [1.0, 2.0]}, r"goal must be three .* got \[1.0, 2.0\]"),
    ):
        with pytest.raises(ValueError, match=message):
            BuildFlightDiagram(Scenario(**wrong), post_world, camera=False)
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False)
    with pytest.raises(ValueError, match=r"timeout .* got -1"):
        fly(diagram, Scenario(timeout=-1.0), post_world)


@pytest.mark.parametrize(
    ("registry", "field", "message"),
    [
        (
            SENSORS,
            {"sensors": {"down": OnboardCamera()}},
            "the sensor 'down' must be a Drake system",
        ),
        (WORLDS, {}, "make for ForestConfig must be a World, got NoneType"),
    ],
)
def test_worlds_and_sensors_of_another_type_are_refused(
    post_world, monkeypatch, registry, field, message
):
    kind = registry.find(registry.registered()[0])
    function = "make" if registry is WORLDS else "build"
    kind = dataclasses.replace(kind, **{function: lambda *_: None})
    monkeypatch.setattr(registry, "entry_for", lambda _: kind)
    with pytest.raises(ValueError, match=message):
        if registry is WORLDS:
            make_world(Scenario().world, 0)
        flown(Scenario(timeout=1.0, **field), post_world)


def test_policies_of_another_type_are_refused(post_world, monkeypatch):
    config = policy_named("straight")
    kind = dataclasses.replace(POLICIES.entry_for(config), build=lambda *_: None)
    monkeypatch.setattr(POLICIES, "entry_for", lambda _: kind)
    monkeypatch.setattr(POLICIES, "entry_name", lambda _: "mine")
    with pytest.raises(ValueError, match="the policy 'mine' must be a Drake system, got NoneType"):
        flown(Scenario(timeout=1.0, policy=config), post_world)


def test_unregistered_configuration_is_refused(post_world):

    class MineConfig:
        rate = 10.0

    with pytest.raises(ValueError, match=r"no policy has the configuration MineConfig; .*Straight"):
        flown(Scenario(policy=MineConfig()), post_world)


@pytest.mark.parametrize("shown", [{"video": True}, {"meshcat": object()}])
def test_video_and_meshcat_need_the_camera(post_world, shown):
    with pytest.raises(ValueError, match="camera must be True with meshcat or video"):
        BuildFlightDiagram(Scenario(), post_world, camera=False, **shown)


def test_sensors_of_a_scenario_are_on_board(post_world):
    text = "sensors: {down: !OnboardCamera {width: 8, height: 6, X_BC: {rotation: !Rpy {deg: "
    text += "[-180, 0, -90]}}}}\ntimeout: 1.0\n"
    scenario = load_config(
        parse_config(Scenario(), text, "text"), overrides=["sensors.down.width=10"]
    )
    rotation = Rotation(value=Rotation.Rpy(deg=[-180.0, 0.0, -90.0]))
    down = Transform(translation=[0.1, 0.0, 0.0], rotation=rotation)
    assert scenario.sensors == {"down": OnboardCamera(width=10, height=6, X_BC=down)}
    assert parse_config(Scenario(), dump_config(scenario), "dump").sensors == scenario.sensors
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    image = diagram.GetOutputPort("down_depth_image_32f").Eval(diagram.CreateDefaultContext())
    assert image.data.shape == (6, 10, 1)
    with_sensor = fly(diagram, scenario, post_world)
    np.testing.assert_array_equal(
        with_sensor.states, flown(Scenario(timeout=1.0), post_world).states
    )


def test_sensor_named_as_a_part_of_the_flight_is_refused(post_world):
    with pytest.raises(ValueError, match=r"a sensor is named 'plant'"):
        flown(Scenario(sensors={"plant": OnboardCamera()}), post_world)
