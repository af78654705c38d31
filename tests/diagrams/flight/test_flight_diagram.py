"""Diagrams of finished systems, and of sensors."""

import dataclasses

import msgpack
import numpy as np
import pytest
from gymnasium.spaces import Box
from pydrake.common.schema import Rotation, Transform
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.gym import DrakeGymEnv
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.diagrams.flight.flight_diagram import AddFlight, BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import Outcome
from splatpilot.diagrams.flight.policies import POLICIES, policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.sensors import SENSORS, SensorEntry
from splatpilot.diagrams.flight.simulation import (
    FlightError,
    fly,
    make_flight_simulator,
    random_flights,
)
from splatpilot.diagrams.worlds.world_registry import WORLDS, make_world
from splatpilot.systems.common.config import dump_config, load_config, parse_config
from splatpilot.systems.common.validation import Config
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.sensing.imu import Imu
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.range_finder import RangeFinder
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams, QuadrotorPlant
from splatpilot.systems.visualization.live import LiveControls


def block(inputs=None, **outputs) -> LeafSystem:
    """Returns a system with inputs of these sizes or types, and constant outputs or their sizes."""
    system = LeafSystem()
    for name, kind in (inputs or {}).items():
        if isinstance(kind, int):
            system.DeclareVectorInputPort(name, kind)
        else:
            system.DeclareAbstractInputPort(name, Value(kind))
    for name, given in outputs.items():
        value = np.zeros(given) if isinstance(given, int) else given
        system.DeclareVectorOutputPort(
            name, len(value), lambda _, output, value=value: output.SetFromVector(value)
        )
    return system


def flown(scenario: Scenario, world, **systems):
    return fly(BuildFlightDiagram(scenario, world, camera=False, **systems))


def test_finished_systems_fly_as_configured_ones(post_world):
    scenario = Scenario(timeout=1.5, policy=policy_named("reactive"))
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


def test_a_policy_needs_only_its_outputs(post_world):
    scenario = Scenario(timeout=8.0, start_radius=0.0, start=[1, 0, 2], goal=[3.0, 0, 2])
    flight = flown(scenario, post_world, policy=block(waypoint=[3.0, 0, 2]))
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
    with pytest.raises(ValueError, match=r"output of the policy Constant.* must be one of hyp"):
        flown(scenario, post_world, policy=ConstantVectorSource(np.zeros(3)))
    with pytest.raises(ValueError, match=r"ports of the plant ConstantVector.* got no 'command'"):
        flown(scenario, post_world, plant=ConstantVectorSource(np.zeros(13)))
    with pytest.raises(ValueError, match=r"of the policy LeafSystem must be one of .* got 'wind'"):
        flown(scenario, post_world, policy=block({"wind": 3}, waypoint=3))


def test_ports_of_another_size_are_named(post_world):
    for policy, message in (
        (block(waypoint=4), r"'waypoint' of .* of 3\) must .* of LeafSystem \(a vector of 4\)"),
        (block(velocity=1), r"input 'velocity' of .* must .* 'velocity' of Leaf.* of 1\)"),
        (block({"goal": 2}, waypoint=3), r"input 'goal' of LeafSystem \(a vector of 2\) must"),
    ):
        with pytest.raises(ValueError, match=message):
            flown(Scenario(timeout=1.0), post_world, policy=policy)

    class Painter(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("color_image", 3)
            self.DeclareVectorOutputPort("waypoint", 3, lambda _, y: None)
            self.camera = OnboardCamera()

    with pytest.raises(ValueError, match=r"'color_image' of SplatCamera \(ImageRgba8U"):
        flown(Scenario(timeout=1.0), post_world, policy=Painter())


def test_scenarios_out_of_range_are_refused(post_world):
    with pytest.raises(ValueError, match=r"timeout .* got -1\.0"):
        BuildFlightDiagram(Scenario(timeout=-1.0), post_world, camera=False)


@pytest.mark.parametrize(
    ("registry", "field", "message"),
    [
        (SENSORS, {"sensors": {"a": OnboardCamera()}}, "the sensor 'a' must be a Drake system"),
        (WORLDS, {}, "make for ForestConfig must be a World, got NoneType"),
        (POLICIES, {}, "the policy 'mine' must be a Drake system, got NoneType"),
    ],
)
def test_entries_of_another_type_are_refused(post_world, monkeypatch, registry, field, message):
    kind = registry.find("straight" if registry is POLICIES else registry.registered()[0])
    function = "make" if registry is WORLDS else "build"
    kind = dataclasses.replace(kind, **{function: lambda *_: None})
    monkeypatch.setattr(registry, "entry_for", lambda _: kind)
    monkeypatch.setattr(POLICIES, "entry_name", lambda _: "mine")
    with pytest.raises(ValueError, match=message):
        if registry is WORLDS:
            make_world(Scenario().world, 0)
        flown(Scenario(timeout=1.0, policy=policy_named("straight"), **field), post_world)


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
    with_sensor = fly(diagram)
    np.testing.assert_array_equal(
        with_sensor.states, flown(Scenario(timeout=1.0), post_world).states
    )


def test_sensor_named_as_a_part_of_the_flight_is_refused(post_world):
    with pytest.raises(ValueError, match=r"different, got 2 of 'plant'; rename"):
        flown(Scenario(sensors={"plant": OnboardCamera()}), post_world)


class Biased(LeafSystem):
    """Estimates the state with an offset of the position."""

    def __init__(self, offset, size=13):
        super().__init__()
        self._offset = np.r_[offset, np.zeros(10)]
        self.DeclareVectorInputPort("state", size)
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context, output):
        output.SetFromVector(self.EvalVectorInput(context, 0).CopyToVector() + self._offset)


def test_policy_and_controller_get_the_estimate_and_the_rest_the_truth(post_world):
    scenario = Scenario(
        start=[1.0, 0, 2], start_radius=0.0, goal=[3.0, 0, 2], policy=policy_named("straight", 1.0)
    )
    diagram = BuildFlightDiagram(
        scenario, post_world, camera=False, estimator=Biased([0.0, 0.3, 0.0])
    )
    context = diagram.CreateDefaultContext()
    for name, y in (("state", 0.0), ("estimated_state", 0.3), ("observation_state", 0.3)):
        assert diagram.GetOutputPort(name).Eval(context)[1] == y
    clearance = diagram.GetOutputPort("clearance").Eval(context)[0]
    truth = BuildFlightDiagram(scenario, post_world, camera=False)
    exact = truth.GetOutputPort("clearance").Eval(truth.CreateDefaultContext())
    assert clearance == exact[0]
    flight = fly(diagram)
    # It flies where it believes to be on the line.
    assert flight.states[-1, 1] == pytest.approx(-0.3, abs=0.05)
    np.testing.assert_allclose(flight.clearances[-1], clearance_of(post_world, flight), atol=1e-12)


def clearance_of(world, flight) -> float:
    return float(world.distance_field.distance(flight.states[-1, :3])) - VEHICLE_RADIUS


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


def test_drakes_environment_acts_through_the_decision(post_world):
    scenario = Scenario(timeout=1.0)
    env = DrakeGymEnv(
        random_flights(scenario, post_world, policy="velocity"),
        time_step=0.1,
        action_space=Box(-1.0, 1.0, (3,)),
        observation_space=Box(-np.inf, np.inf, (13,)),
        reward=lambda system, context: 0.0,
        action_port_id="velocity",
        observation_port_id="observation_state",
    )
    env.reset(seed=1)
    steps = (env.step(np.array([1.0, 0.0, 0.0])) for _ in range(20))
    ended = next(observation for observation, _, terminated, _, _ in steps if terminated)
    assert ended[0] > 1.4


def test_inputs_of_given_systems_are_connected_or_exported(post_world):
    class Windy(QuadrotorPlant):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.DeclareVectorInputPort("gust", 3)

    scenario = Scenario()
    start = sample_initial_state(scenario, post_world)
    diagram = BuildFlightDiagram(
        scenario, post_world, camera=False, plant=Windy(scenario.vehicle, start)
    )
    assert diagram.HasInputPort("plant_gust")

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("mine", Windy(scenario.vehicle, start))
    gust = builder.AddSystem(ConstantVectorSource(np.ones(3)))
    builder.Connect(gust.get_output_port(), plant.GetInputPort("gust"))
    AddFlight(builder, scenario, post_world, plant=plant, camera=False)
    assert not builder.Build().HasInputPort("plant_gust")


def test_a_controller_may_also_read_what_the_policy_reads(post_world):
    class ToGoal(LeafSystem):
        def __init__(self):
            super().__init__()
            for name, size in (("state", 13), ("acceleration", 3), ("goal", 3)):
                self.DeclareVectorInputPort(name, size)
            self.DeclareVectorOutputPort("command", 4, self._calc)

        def _calc(self, context, output):
            output.SetFromVector([9.81 + self.GetInputPort("goal").Eval(context)[2], 0, 0, 0])

    systems = {"policy": block(acceleration=3), "controller": ToGoal()}
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False, **systems)
    assert not diagram.HasInputPort("controller_goal")
    command = diagram.GetOutputPort("command").Eval(diagram.CreateDefaultContext())
    assert command[0] == pytest.approx(9.81 + post_world.p_WG[2])


class Constant(LeafSystem):
    """Has the input `command` and an output that is always zero."""

    def __init__(self, name, size):
        super().__init__()
        self.DeclareVectorInputPort("command", 4)
        self.DeclareVectorOutputPort(
            name, size, lambda _, output: output.SetZero(), {self.nothing_ticket()}
        )


@pytest.mark.parametrize(
    ("systems", "message"),
    [
        ({"policy": "speed"}, "policy must be one of command, .*, got speed"),
        ({"policy": "command", "controller": FlatnessController()}, "other than command"),
        ({"estimator": Biased([0, 0, 0], size=12)}, r"'state' of Biased \(a vector of 12\) must"),
        ({"estimator": Constant("state", 12)}, r"'state' of Constant \(a vector of 12\)"),
        ({"plant": Constant("state", 12)}, r"'state' of Constant \(a vector of 12\)"),
        ({"plant": QuadrotorParams()}, "plant must be of type System, got a QuadrotorParams"),
        ({"estimator": abs}, "estimator must be of type System, got a builtin_function"),
    ],
)
def test_systems_that_do_not_fit_are_named(post_world, systems, message):
    with pytest.raises(ValueError, match=message):
        BuildFlightDiagram(Scenario(), post_world, camera=False, **systems)


def test_arguments_in_the_wrong_order_are_named(post_world):
    with pytest.raises(ValueError, match="scenario must be of type Scenario, got a World"):
        BuildFlightDiagram(post_world, Scenario(), camera=False)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("policy", ["planner", "straight", "reactive"])
def test_an_estimate_that_is_not_finite_ends_the_flight_by_name(post_world, policy):
    class Lost(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("state", 13)
            self.DeclareVectorOutputPort("state", 13, self._calc)

        def _calc(self, context, output):
            scale = np.nan if context.get_time() > 0.4 else 1.0
            output.SetFromVector(scale * self.EvalVectorInput(context, 0).CopyToVector())

    with pytest.raises(FlightError, match=r"state' .* finite, got \[nan.*; check the") as raised:
        flown(Scenario(policy=policy_named(policy)), post_world, estimator=Lost())
    assert raised.value.flight.times[-1] > 0.3


def test_an_algebraic_loop_is_named(post_world):
    systems = {
        "policy": block({"state": 13}, command=4),
        "estimator": block({"command": 4}, state=13),
    }
    with pytest.raises(ValueError, match=r"must not depend on .* got .*policy\.command.*; declare"):
        BuildFlightDiagram(Scenario(), post_world, camera=False, **systems)


def test_an_algebraic_loop_of_a_sensor_is_named(post_world, monkeypatch):
    entry = SensorEntry(EchoConfig, lambda *_: block({"echo_sum": 1}, sum=1))
    monkeypatch.setitem(SENSORS._entries, "EchoConfig", entry)
    scenario = Scenario(sensors={"echo": EchoConfig()})
    with pytest.raises(ValueError, match=r"got echo\.echo_sum -> echo\.sum -> echo\.echo_sum; dec"):
        BuildFlightDiagram(scenario, post_world, camera=False)


@dataclasses.dataclass
class EchoConfig(Config):
    pass


def test_sensors_connect_to_command_images_and_each_other(post_world, monkeypatch):
    class Echo(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("goal", 3)
            self.DeclareVectorInputPort("height_range", 1)
            image = Value(ImageDepth32F())
            self.DeclareAbstractInputPort("depth_image_32f", image)
            self.DeclareVectorOutputPort("sum", 1, self._calc)

        def _calc(self, context, output):
            image = self.GetInputPort("depth_image_32f").Eval(context).data
            height = self.GetInputPort("height_range").Eval(context)
            output.SetAtIndex(0, height[0] + image.size)

    entry = SensorEntry(EchoConfig, lambda config, world, scenario: Echo())
    monkeypatch.setitem(SENSORS._entries, "EchoConfig", entry)
    sensors = {"echo": EchoConfig(), "height": RangeFinder(noise=0.0), "imu": Imu()}
    scenario = Scenario(sensors=sensors, timeout=0.5, policy=policy_named("straight", 1.0))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = make_flight_simulator(diagram)
    simulator.AdvanceTo(0.5)
    root = simulator.get_context()
    assert diagram.GetOutputPort("echo_sum").Eval(root)[0] == np.inf  # no ground in this hall
    force = diagram.GetOutputPort("imu_accelerometer").Eval(root)
    assert 5.0 < force[2] < 25.0


def test_an_input_that_a_sensor_cannot_have_is_named(post_world, monkeypatch):
    entry = SensorEntry(EchoConfig, lambda *_: block({"wind": 3}))
    monkeypatch.setitem(SENSORS._entries, "EchoConfig", entry)
    with pytest.raises(ValueError, match=r"sensor 'gust' LeafSystem must be one of .* got 'wind'"):
        flown(Scenario(sensors={"gust": EchoConfig()}), post_world)


def test_an_image_of_another_size_is_refused(post_world):
    policy = block({"depth_image_32f": ImageDepth32F(10, 10)}, velocity=3)
    with pytest.raises(ValueError, match=r"ImageDepth32F of 10x10.*ImageDepth32F of 64x36"):
        BuildFlightDiagram(Scenario(), post_world, camera=False, policy=policy)


def test_image_time_of_a_late_policy_camera_is_that_of_the_capture(post_world):
    noise = ObservationNoise(latency=0.2)
    scenario = Scenario(policy=policy_named("reactive"), observation=noise, timeout=2.0)
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = make_flight_simulator(diagram)
    simulator.AdvanceTo(1.0)
    camera = diagram.GetSubsystemByName("policy_camera")
    context = camera.GetMyContextFromRoot(simulator.get_context())
    assert camera.image_time_output_port().Eval(context)[0] == pytest.approx(0.8)


def test_output_delay_delays_the_camera(post_world):
    overrides = ["camera.output_delay=0.1", "camera.width=8", "camera.height=6"]
    scenario = load_config(Scenario(timeout=2.0), overrides=overrides)
    diagram = BuildFlightDiagram(scenario, post_world)
    simulator = make_flight_simulator(diagram)
    simulator.AdvanceTo(0.9)
    plant = diagram.GetSubsystemByName("plant")
    state = plant.GetOutputPort("state")
    before = state.Eval(plant.GetMyContextFromRoot(simulator.get_context()))[:3]
    simulator.AdvanceTo(1.0)
    camera = diagram.GetSubsystemByName("camera")
    context = camera.GetMyContextFromRoot(simulator.get_context())
    assert camera.image_time_output_port().Eval(context)[0] == pytest.approx(0.9)
    X_WB = camera.body_pose_in_world_output_port().Eval(context)
    np.testing.assert_allclose(X_WB.translation(), before, atol=1e-3)


@pytest.mark.parametrize("name", ["output_delay=2", "capture_offset=0.1"])
def test_delays_that_a_camera_cannot_have_are_refused(name):
    with pytest.raises(ValueError, match=rf"camera\.{name.partition('=')[0]} must be"):
        load_config(Scenario(), overrides=[f"camera.{name}"]).validate()


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
    scene_graph = builder.AddSystem(SceneGraph())
    starts = {"flight": [1.0, 0, 2], "other": [1.0, 2, 2]}
    flights = [
        AddFlight(
            builder,
            Scenario(start=start, start_radius=0.0),
            post_world,
            name=name,
            camera=False,
            scene_graph=scene_graph,
        )
        for name, start in starts.items()
    ]
    diagram = builder.Build()
    assert scene_graph.HasRenderer("splats")
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port()
    query = query.Eval(scene_graph.GetMyContextFromRoot(context))
    for flight, start in zip(flights, starts.values(), strict=True):
        assert flight.geometry is not None
        frame = flight.geometry.get_frame_id()
        np.testing.assert_allclose(query.GetPoseInWorld(frame).translation(), start)
