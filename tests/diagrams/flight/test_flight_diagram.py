"""Diagrams of finished systems, and of sensors."""

import dataclasses

import msgpack
import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.common.schema import Rotation, Transform, Uniform
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator_,  # pyright: ignore[reportAttributeAccessIssue]
    SimulatorConfig,
)
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.diagrams.flight.flight_diagram import AddFlight, BuildFlightDiagram
from splatpilot.diagrams.flight.policies import POLICIES, policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.sensors import SENSORS, SensorEntry
from splatpilot.diagrams.flight.simulation import FlightError, fly, make_flight_simulator
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import WORLDS, make_world
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.systems.common.validation import Config
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.sensing.imu import Imu, RangeFinder
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams, QuadrotorPlant
from splatpilot.systems.vehicle.vehicles import Kingfisher
from splatpilot.systems.vehicle.wind import Wind
from splatpilot.systems.visualization.live import LiveControls


def block(inputs=None, **outputs) -> LeafSystem:
    """Returns a system with inputs of these sizes or types, and outputs of these sizes that are
    zero, or of these (size, function): of a reader of inputs by name and of the time."""
    system = LeafSystem()
    for name, kind in (inputs or {}).items():
        if isinstance(kind, int):
            system.DeclareVectorInputPort(name, kind)
        else:
            system.DeclareAbstractInputPort(name, Value(kind))

    def declare(name, size, calc=lambda read, time: None):
        def write(context, output):
            value = calc(lambda port: system.GetInputPort(port).Eval(context), context.get_time())
            output.SetFromVector(np.zeros(size) if value is None else value)

        system.DeclareVectorOutputPort(name, size, write)

    for name, given in outputs.items():
        declare(name, *(given if isinstance(given, tuple) else (given,)))
    return system


def biased(read, time):
    return read("state") + 0.3 * np.eye(13)[1]


def lost(read, time):
    return read("state") * (np.nan if time > 0.2 else 1.0)


def flown(scenario: Scenario, world, **systems):
    return fly(BuildFlightDiagram(scenario, world, camera=False, **systems))


def test_finished_systems_fly_as_configured_ones(post_world):
    scenario = Scenario(timeout=0.5, policy=policy_named("reactive"))
    configured = flown(scenario, post_world)
    given = flown(
        scenario,
        post_world,
        policy=Reactive(scenario.policy),
        plant=QuadrotorPlant(scenario.vehicle, sample_initial_state(scenario, post_world)),
        controller=FlatnessController(scenario.controller, scenario.vehicle),
    )
    np.testing.assert_array_equal(given.states, configured.states)
    # Without a configuration that says how, the policy looks through the default camera.
    scenario.policy = policy_named("planner")
    np.testing.assert_array_equal(
        flown(scenario, post_world, policy=Reactive()).states[-1], configured.states[-1]
    )


def test_appearance_changes_colors_and_no_flight(post_world):
    colors, depths, flights = [], [], []
    for appearance in (0.0, 1.0, 1.0):
        diagram = BuildFlightDiagram(Scenario(timeout=0.3, appearance=appearance), post_world)
        context = diagram.CreateDefaultContext()
        colors.append(diagram.GetOutputPort("color_image").Eval(context).data[..., :3].astype(int))
        depths.append(np.array(diagram.GetOutputPort("depth_image_32f").Eval(context).data))
        flights.append(fly(diagram).states)
    assert np.abs(colors[0] - colors[1]).mean() > 5.0
    np.testing.assert_array_equal(colors[1], colors[2])
    np.testing.assert_array_equal(depths[0], depths[1])
    np.testing.assert_array_equal(flights[0], flights[1])


@pytest.mark.parametrize(
    ("registry", "name", "function", "message"),
    [
        (SENSORS, "Imu", "build", "the sensor 'a' must be a Drake system"),
        (WORLDS, "ForestConfig", "make", "make for ForestConfig must be a World, got NoneType"),
        (POLICIES, "straight", "build", "the policy 'mine' must be a Drake system, got NoneType"),
    ],
)
def test_entries_of_another_type_are_refused(
    post_world, monkeypatch, registry, name, function, message
):
    entry = dataclasses.replace(registry.find(name), **{function: lambda *_: None})
    monkeypatch.setattr(registry, "entry_for", lambda _: entry)
    monkeypatch.setattr(POLICIES, "entry_name", lambda _: "mine")
    with pytest.raises(ValueError, match=message):
        make_world(ForestConfig(length=8.0, width=6.0), 0)
        flown(Scenario(policy=policy_named("straight"), sensors={"a": Imu()}), post_world)


def test_sensors_of_a_scenario_are_on_board(post_world):
    rotation = "{rotation: !Rpy {deg: [-180, 0, -90]}}"
    text = (
        f"sensors: {{down: !OnboardCamera {{width: 8, height: 6, X_BC: {rotation}}}}}\ntimeout: 1"
    )
    scenario = parse_config(Scenario(), text, "text")
    scenario = load_config(scenario, overrides=["sensors.down.width=10"])
    rotation = Rotation(value=Rotation.Rpy(deg=[-180.0, 0.0, -90.0]))
    down = Transform(translation=[0.1, 0.0, 0.0], rotation=rotation)
    assert scenario.sensors == {"down": OnboardCamera(width=10, height=6, X_BC=down)}
    assert parse_config(Scenario(), dump_config(scenario), "dump").sensors == scenario.sensors
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    image = diagram.GetOutputPort("down_depth_image_32f").Eval(diagram.CreateDefaultContext())
    assert image.data.shape == (6, 10, 1)
    bare = flown(Scenario(timeout=1.0), post_world)
    np.testing.assert_array_equal(fly(diagram).states, bare.states)


def test_policy_and_controller_get_the_estimate_and_the_rest_the_truth(post_world):
    ends = {"start": [1.0, 0, 2], "start_radius": 0.0, "goal": [3.0, 0, 2]}
    scenario = Scenario(policy=policy_named("straight", 1.0), **ends)
    estimator = block({"state": 13}, state=(13, biased))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False, estimator=estimator)
    context = diagram.CreateDefaultContext()
    for name, y in (("state", 0.0), ("estimated_state", 0.3), ("observation_state", 0.3)):
        assert diagram.GetOutputPort(name).Eval(context)[1] == y
    flight = fly(diagram)
    # It flies where it believes to be on the line.
    assert flight.states[-1, 1] == pytest.approx(-0.3, abs=0.05)
    distance = float(post_world.distance_field.distance(flight.states[-1, :3]))
    assert flight.clearances[-1] == pytest.approx(distance - VEHICLE_RADIUS, abs=1e-12)


@pytest.mark.parametrize("decision", ["velocity", "acceleration", "waypoint", "command"])
def test_a_decision_can_be_an_input_of_the_diagram(post_world, decision):
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False, policy=decision)
    assert [diagram.get_input_port(0).get_name()] == [decision]
    value = {"command": [9.81, 0, 0, 0], "waypoint": [2.0, 0, 2.0]}.get(decision, [0.5, 0.0, 0.0])
    simulator = make_flight_simulator(diagram)
    root = simulator.get_mutable_context()
    diagram.get_input_port(0).FixValue(root, value)
    simulator.AdvanceTo(0.5)
    state = diagram.GetOutputPort("observation_state").Eval(root)
    assert (state[0] > 1.02) == (decision != "command")
    image = diagram.GetOutputPort("observation_depth_image_32f").Eval(root)
    assert np.isfinite(image.data).any()


def test_inputs_of_given_systems_are_connected_or_exported(post_world):
    class Windy(QuadrotorPlant):
        def __init__(self):
            super().__init__(None, sample_initial_state(Scenario(), post_world))
            self.DeclareVectorInputPort("gust", 3)

    controller = block(
        {"state": 13, "acceleration": 3, "goal": 3},
        command=(4, lambda read, time: [9.81 + read("goal")[2], 0, 0, 0]),
    )
    systems = {"policy": block(acceleration=3), "controller": controller, "plant": Windy()}
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False, **systems)
    assert diagram.HasInputPort("plant_gust") and not diagram.HasInputPort("controller_goal")
    command = diagram.GetOutputPort("command").Eval(diagram.CreateDefaultContext())
    assert command[0] == pytest.approx(9.81 + post_world.p_WG[2])

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("mine", Windy())
    gust = builder.AddSystem(ConstantVectorSource(np.ones(3)))
    builder.Connect(gust.get_output_port(), plant.GetInputPort("gust"))
    AddFlight(builder, Scenario(), post_world, plant=plant, camera=False)
    assert not builder.Build().HasInputPort("plant_gust")


class MineConfig:
    rate = 10.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scenario": Scenario(timeout=-1.0)}, r"timeout .* got -1\.0"),
        ({"scenario": abs}, "scenario must be of type Scenario, got a builtin_function"),
        ({"scenario": Scenario(policy=MineConfig())}, "no policy has the configuration MineConfig"),
        ({"scenario": Scenario(sensors={"plant": Imu()})}, "different, got 2 of 'plant'; rename"),
        ({"video": True}, "camera must be True with meshcat or video"),
        ({"meshcat": object()}, "camera must be True with meshcat or video"),
        ({"policy": "speed"}, "policy must be one of command, .*, got speed"),
        ({"policy": "command", "controller": FlatnessController()}, "other than command"),
        ({"policy": ConstantVectorSource(np.zeros(3))}, "output of the policy Constant.* of hyp"),
        ({"policy": block({"wind": 3}, waypoint=3)}, "of the policy LeafSystem must .* got 'wind'"),
        ({"policy": block(waypoint=4)}, r"'waypoint' of .* of 3\) must .* \(a vector of 4\)"),
        ({"policy": block(velocity=1)}, r"'velocity' of .* must .* 'velocity' of Leaf.* of 1\)"),
        ({"policy": block({"goal": 2}, waypoint=3)}, r"'goal' of LeafSystem \(a vector of 2\)"),
        (
            {"policy": block({"color_image": 3}, waypoint=3)},
            r"'color_image' of SplatCamera \(ImageRgba8U",
        ),
        (
            {"policy": block({"depth_image_32f": ImageDepth32F(10, 10)}, velocity=3)},
            "ImageDepth32F of 10x10.*ImageDepth32F of 64x36",
        ),
        (
            {"policy": block(velocity=3), "scenario": Scenario(decision_delay=[0.0, 0.1])},
            "decision_delay must be empty for a policy without",
        ),
        ({"plant": ConstantVectorSource(np.zeros(13))}, "ports of the plant .* got no 'command'"),
        ({"plant": block({"command": 4}, state=12)}, r"'state' of Leaf.* \(a vector of 12\)"),
        ({"plant": QuadrotorParams()}, "plant must be of type System, got a QuadrotorParams"),
        ({"estimator": block({"state": 12}, state=13)}, r"'state' of Leaf.* \(a vector of 12\)"),
        ({"estimator": block({"state": 13}, state=12)}, r"'state' of Leaf.* \(a vector of 12\)"),
        ({"estimator": abs}, "estimator must be of type System, got a builtin_function"),
        (
            {
                "policy": block({"state": 13}, command=4),
                "estimator": block({"command": 4}, state=13),
            },
            r"must not depend on .* got .*policy\.command.*; declare",
        ),
    ],
)
def test_what_makes_no_flight_is_named(post_world, given, message):
    with pytest.raises(ValueError, match=message):
        BuildFlightDiagram(**{"scenario": Scenario(), "world": post_world, "camera": False} | given)


@pytest.mark.parametrize("policy", ["planner", "straight", "reactive"])
def test_an_estimate_that_is_not_finite_ends_the_flight_by_name(post_world, policy):
    scenario = Scenario(policy=policy_named(policy))
    estimator = block({"state": 13}, state=(13, lost))
    with pytest.raises(FlightError, match=r"state' .* finite, got \[nan.*; check the") as raised:
        flown(scenario, post_world, estimator=estimator)
    assert raised.value.flight.times[-1] > 0.1


@dataclasses.dataclass
class EchoConfig(Config):
    pass


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        ({"echo_sum": 1}, {"sum": 1}, r"got echo\.echo_sum -> echo\.sum -> echo\.echo_sum; dec"),
        ({"wind": 3}, {}, r"sensor 'echo' LeafSystem must be one of .* got 'wind'"),
    ],
)
def test_sensors_that_do_not_fit_are_named(post_world, monkeypatch, inputs, outputs, message):
    entry = SensorEntry(EchoConfig, lambda *_: block(inputs, **outputs))
    monkeypatch.setitem(SENSORS._entries, "EchoConfig", entry)
    with pytest.raises(ValueError, match=message):
        flown(Scenario(sensors={"echo": EchoConfig()}), post_world)


def test_sensors_connect_to_command_images_and_each_other(post_world, monkeypatch):
    def sum_up(read, time):
        return read("height_range") + read("depth_image_32f").data.size

    inputs = {"goal": 3, "height_range": 1, "depth_image_32f": ImageDepth32F()}
    entry = SensorEntry(EchoConfig, lambda *_: block(inputs, sum=(1, sum_up)))
    monkeypatch.setitem(SENSORS._entries, "EchoConfig", entry)
    sensors = {"echo": EchoConfig(), "height": RangeFinder(noise=0.0), "imu": Imu()}
    scenario = Scenario(sensors=sensors, policy=policy_named("straight", 1.0))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = make_flight_simulator(diagram)
    simulator.AdvanceTo(0.3)
    root = simulator.get_context()
    assert diagram.GetOutputPort("echo_sum").Eval(root)[0] == np.inf  # no ground in this hall
    assert 5.0 < diagram.GetOutputPort("imu_accelerometer").Eval(root)[2] < 25.0


@pytest.mark.parametrize(
    ("name", "override"),
    [("policy_camera", "observation.latency=0.1"), ("camera", "camera.output_delay=0.1")],
)
def test_late_cameras_see_from_where_the_vehicle_was(post_world, name, override):
    overrides = [override, "camera.width=8", "camera.height=6", "policy=!ReactiveConfig {}"]
    diagram = BuildFlightDiagram(load_config(Scenario(), overrides=overrides), post_world)
    simulator = make_flight_simulator(diagram)
    simulator.AdvanceTo(0.4)
    before = np.array(diagram.GetOutputPort("state").Eval(simulator.get_context())[:3])
    simulator.AdvanceTo(0.5)
    camera = diagram.GetSubsystemByName(name)
    context = camera.GetMyContextFromRoot(simulator.get_context())
    assert camera.image_time_output_port().Eval(context)[0] == pytest.approx(0.4)
    X_WB = camera.body_pose_in_world_output_port().Eval(context)
    np.testing.assert_allclose(X_WB.translation(), before, atol=1e-3)


def test_meshcat_draws_on_request_and_gives_controls_of_teleop(post_world):
    scenario = Scenario(timeout=1.0)
    scenario.camera.width, scenario.camera.height = 32, 24
    meshcat = Meshcat()
    draw = ["axes", "thrust", "waypoint", "nearest", "barrier", "depth", "limits"]
    diagram = BuildFlightDiagram(scenario, post_world, meshcat, draw=draw)
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    for name in ("thrust", "waypoint", "nearest", "barrier", "limits", "vehicle/camera/depth"):
        assert meshcat.HasPath(f"/splatpilot/{name}"), name
    with pytest.raises(ValueError, match="draw must be without frustum"):
        BuildFlightDiagram(scenario, post_world, meshcat, draw=["frustum"])
    scenario.policy = policy_named("reactive")
    BuildFlightDiagram(scenario, post_world, meshcat, draw=["frustum"])
    assert meshcat.HasPath("/splatpilot/vehicle/policy_camera/frustum")
    scenario.policy = policy_named("diffaero")
    with pytest.raises(ValueError, match="draw must be without waypoint"):
        BuildFlightDiagram(scenario, post_world, meshcat, draw=["waypoint"])
    scenario.policy = policy_named("teleop")
    diagram = BuildFlightDiagram(scenario, post_world, meshcat)
    meshcat.SetSliderValue("up (arrows)", 2.0)
    flight = fly(diagram)
    assert flight.states[-1, 2] > flight.states[0, 2] + 0.5
    assert np.ptp(flight.states[:, :2], axis=0).max() < 0.1


def test_live_controls_drag_the_goal_and_push_the_vehicle_of_a_flight(post_world, monkeypatch):
    monkeypatch.setattr(LiveControls, "wait_for_viewer", lambda self: None)
    meshcat = Meshcat()
    scenario = Scenario(timeout=0.5, policy=policy_named("teleop"))
    flown = {}
    for name in ("", "goal", "plant"):
        diagram = BuildFlightDiagram(scenario, post_world, camera=False)
        controls = LiveControls(meshcat, diagram)
        meshcat.SetSliderValue("real-time rate", 0.0)
        start = post_world.p_WG if name == "goal" else post_world.p_WS
        ends = (start, np.add(start, [0.0, 0.0, 0.4])) if name else ([], [])
        drag = {"type": "mouse_drag", "name": name and f"/drake/illustration/{name}/{name}"}
        drag |= {"drag_anchor": [*map(float, ends[0])], "drag_target": [*map(float, ends[1])]}
        meshcat._InjectWebsocketMessage(msgpack.packb(drag))
        flown[name] = fly(diagram, monitor=controls).states[-1, :3]
        goal = msgpack.unpackb(meshcat._GetPackedTransform("/splatpilot/goal"))["matrix"][12:15]
        raised = 0.4 if name == "goal" else 0.0
        np.testing.assert_allclose(goal, np.add(post_world.p_WG, [0, 0, raised]), atol=1e-6)
    np.testing.assert_allclose(flown["goal"], flown[""], atol=1e-9)
    assert flown["plant"][2] > flown[""][2] + 0.05


def test_flights_share_a_scene_graph(post_world):
    builder = DiagramBuilder()
    scene_graph, frames = builder.AddSystem(SceneGraph()), {}
    starts = {"flight": [1.0, 0, 2], "other": [1.0, 2, 2]}
    for name, start in starts.items():
        scenario = Scenario(start=start, start_radius=0.0, policy=policy_named("straight"))
        options = {"name": name, "camera": False, "scene_graph": scene_graph}
        frames[name] = AddFlight(builder, scenario, post_world, **options).geometry.get_frame_id()
    diagram = builder.Build()
    assert scene_graph.HasRenderer("splats")
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    for name, start in starts.items():
        np.testing.assert_allclose(query.GetPoseInWorld(frames[name]).translation(), start)


@pytest.mark.parametrize("name", ["planner", "straight"])
def test_a_privileged_flight_has_the_derivatives_of_differences(post_world, name):
    diagram = BuildFlightDiagram(Scenario(policy=policy_named(name)), post_world, camera=False)
    converted = diagram.ToAutoDiffXd()
    start = diagram.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    start[3:6] = [0.3, -0.2, 0.1]

    def end(system, scalar, state) -> np.ndarray:
        simulator = Simulator_[scalar](system)
        config = SimulatorConfig(max_step_size=0.02, use_error_control=False)
        ApplySimulatorConfig(config, simulator)
        simulator.get_mutable_context().SetContinuousState(state)
        simulator.AdvanceTo(0.3)
        return simulator.get_context().get_continuous_state_vector().CopyToVector()

    found = end(converted, AutoDiffXd, InitializeAutoDiff(start).ravel())
    expected = end(diagram, float, start)
    np.testing.assert_allclose(ExtractValue(found).ravel(), expected, rtol=0, atol=1e-12)
    if name == "planner":  # Its decisions jump.
        return
    steps = 1e-6 * np.eye(13)
    ends = [(end(diagram, float, start + h), end(diagram, float, start - h)) for h in steps]
    differences = [(ahead - behind) / 2e-6 for ahead, behind in ends]
    gradient = ExtractGradient(found)
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=1e-5, atol=1e-6)


def test_wind_and_thrust_move_the_vehicle_and_its_radius_decides_collisions(post_world):
    def state(**fields):
        policy = policy_named("straight")
        scenario = Scenario(timeout=0.5, policy=policy, start_radius=0.0, **fields)
        return flown(scenario, post_world).states[-1]

    calm = state()
    np.testing.assert_array_equal(calm, state(wind=Wind()))
    assert state(wind=Wind(mean=[0.0, 4.0, 0.0]))[4] > calm[4] + 0.1
    gusty = [state(wind=Wind(gusts=15.0), seed=seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(gusty[0], gusty[1])
    assert np.abs(gusty[0] - gusty[2])[3:6].max() > 0.05
    weak = Kingfisher(thrust_scale=Uniform(min=0.8, max=0.9))
    assert state(vehicle=weak)[2] < state(vehicle=Kingfisher())[2]
    slim, wide = (
        flown(Scenario(timeout=0.1, vehicle=QuadrotorParams(radius=radius)), post_world)
        for radius in (0.1, 0.3)
    )
    assert slim.clearances[0] - wide.clearances[0] == pytest.approx(0.2)
