import json
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from splatpilot.diagrams.flight.flight_diagram import (
    AddFlight,
    AddMeshcat,
    AddMovingBody,
    BuildFlightDiagram,
)
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.simulation import Outcome, fly, fly_all
from splatpilot.diagrams.worlds.moving_spheres import MovingSphere
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace, MovingSpheres
from splatpilot.systems.common.config import dump_config, parse_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.splats.moving_bodies import MovingObstacles
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


@pytest.fixture(scope="module")
def open_world(post_world) -> World:
    """The hall without its post, and with one Gaussian beyond it."""
    walls = post_world.distance_field
    field = AnalyticDistanceField([HalfSpace([0, 0, 1], -9.0)], walls.lower_W, walls.upper_W)
    beyond = GaussianScene.from_colors([[50] * 3], [[1, 0, 0, 0]], [[0.1] * 3], [0.9], [[1, 0, 0]])
    esdf = esdf_from_distance_field(field, 0.2)
    return replace(post_world, gaussians=beyond, distance_field=field, esdf=esdf)


def with_sphere(world: World, path: np.ndarray) -> World:
    """The world with one red sphere of 0.5 m radius on a path, a row every 0.02 s."""
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    quats, scales = np.tile([1.0, 0, 0, 0], (300, 1)), np.full((300, 3), 0.06)
    red = np.tile([1.0, 0.0, 0.0], (300, 1))
    sphere = GaussianScene.from_colors(0.5 * directions, quats, scales, np.full(300, 0.99), red)
    spheres = MovingSpheres([0.5], [path], 0.02)
    return replace(world, moving=MovingObstacles(spheres, [sphere]))


def falling(x: float, y: float, speed: float) -> np.ndarray:
    """A path down from 9 m over (x, y) at a speed [m/s]."""
    z = 9.0 - 0.02 * speed * np.arange(1000)
    return np.column_stack([np.full(1000, x), np.full(1000, y), z])


def hovering(**changes) -> Scenario:
    """A vehicle that goes nowhere: its waypoint is where it is."""
    return Scenario(timeout=4.0, start_radius=0.0, policy=policy_named("straight", 0.01), **changes)


def test_cameras_planner_and_collision_meet_a_body_of_the_user(post_world):
    builder = DiagramBuilder()
    scenario = Scenario(start_radius=0.0, policy=policy_named("diffaero"))
    parts = AddFlight(builder, scenario, post_world)
    X_WO = RigidTransform(post_world.p_WS + np.array([2.0, 0.0, 0.0]))
    source = ConstantValueSource(Value(X_WO))
    pose = builder.AddSystem(source).get_output_port()
    red = with_sphere(post_world, falling(0.0, 0.0, 1.0)).moving.bodies[0]
    AddMovingBody(builder, parts, "body", red, 0.5, pose)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = parts.collision.GetMyContextFromRoot(context)
    clearance = parts.collision.GetOutputPort("clearance").Eval(own)
    assert clearance == pytest.approx(2.0 - 0.5 - VEHICLE_RADIUS)
    for name in ("camera", "policy_camera"):
        camera = diagram.GetSubsystemByName(name)
        depth = camera.GetOutputPort("depth_image_32f")
        image = depth.Eval(camera.GetMyContextFromRoot(context)).data
        assert np.nanmin(image) == pytest.approx(1.5, abs=0.15)


def test_a_sphere_hits_at_its_time(post_world):
    hit_at = (9.0 - 2.0 - 0.5 - VEHICLE_RADIUS) / 3.0
    scenario = hovering()
    for aside, outcome in ((0.0, Outcome.COLLISION), (2.5, Outcome.TIMEOUT)):
        world = with_sphere(post_world, falling(1.0, aside, 3.0))
        flight = fly(BuildFlightDiagram(scenario, world, camera=False))
        assert flight.outcome == outcome
        if not aside:
            assert flight.times[-1] == pytest.approx(hit_at, abs=0.045)
            assert flight.clearances[-1] < 0 < flight.clearances[-3]
    # The record of clearances has the sphere at the time of each sample.
    fall = 3.0 * flight.times
    sphere = np.column_stack([np.ones_like(fall), np.full_like(fall, 2.5), 9.0 - fall])
    apart = np.linalg.norm(flight.states[:, :3] - sphere, axis=1) - 0.5 - VEHICLE_RADIUS
    to_post = np.linalg.norm(flight.states[:, :2] - [5.0, 0.0], axis=1) - 0.5 - VEHICLE_RADIUS
    np.testing.assert_allclose(flight.clearances, np.minimum(apart, to_post), atol=0.07)


@pytest.mark.parametrize("policy", ["planner", "reactive"])
def test_flights_are_bitwise_identical(post_world, policy):
    scenario = Scenario(timeout=1.0, policy=policy_named(policy))
    world = with_sphere(post_world, falling(3.0, 0.6, 2.0))
    diagram = BuildFlightDiagram(scenario, world, camera=False)
    first = fly(diagram)
    for flight in (fly(diagram), fly(BuildFlightDiagram(scenario, world, camera=False))):
        for name in ("times", "states", "commands", "clearances", "hypotheses"):
            np.testing.assert_array_equal(getattr(flight, name), getattr(first, name))


def test_the_camera_of_a_flight_sees_the_sphere_come(post_world):
    approach = np.column_stack([4.0 - 0.02 * np.arange(100), np.zeros(100), np.full(100, 2.0)])
    diagram = BuildFlightDiagram(hovering(), with_sphere(post_world, approach))
    root = diagram.CreateDefaultContext()
    depths, red = [], []
    for time in (0.0, 0.5, 1.0):
        root.SetTime(time)
        depth = diagram.GetOutputPort("depth_image_32f").Eval(root).data[..., 0]
        color = diagram.GetOutputPort("color_image").Eval(root).data.astype(int)
        depths.append(depth[120, 160])
        red.append((color[..., 0] > color[..., 1] + 150).sum())
    # The camera sits 0.1 m before the vehicle's center, at x = 1.
    np.testing.assert_allclose(depths, [2.4, 1.9, 1.4], atol=0.08)
    assert red[0] < red[1] < red[2]


def test_the_planner_keeps_clear_of_a_sphere_where_it_will_be(post_world):
    blind = fly(BuildFlightDiagram(Scenario(), post_world, camera=False))
    for at, speed in ((2.8, 0.0), (3.0, 4.0)):
        meeting = np.argmax(blind.states[:, 0] > at)
        way = speed * (0.02 * np.arange(600) - blind.times[meeting])
        path = blind.states[meeting, :3] + np.column_stack([0 * way, way, 0 * way])
        world = with_sphere(post_world, path)
        rows = zip(blind.times, blind.states[:, :3], strict=True)
        hit = np.array([world.field_at(time).distance(p) for time, p in rows]) - VEHICLE_RADIUS
        assert hit.min() < -0.4
        flight = fly(BuildFlightDiagram(Scenario(timeout=15.0), world, camera=False))
        assert flight.outcome == Outcome.GOAL and flight.clearances.min() > 0


def test_meshcat_shows_moving_spheres_and_a_start_in_one_is_refused(post_world):
    world = with_sphere(post_world, falling(1.0, 0.0, 3.0) - [0.0, 0.0, 7.0])
    with pytest.raises(InfeasibleFlightError, match=r"start .* from the nearest surface"):
        sample_initial_state(hovering(), world)
    meshcat = Meshcat()
    world = with_sphere(post_world, falling(1.0, 0.0, 3.0))
    for flown, shown in ((post_world, False), (world, True)):
        diagram = BuildFlightDiagram(hovering(), flown, meshcat=meshcat)
        diagram.ForcedPublish(diagram.CreateDefaultContext())
        assert meshcat.HasPath("/splatpilot/moving/0") == shown


@pytest.mark.parametrize(
    ("policy", "outcome"), [("straight", Outcome.COLLISION), ("planner", Outcome.GOAL)]
)
def test_two_vehicles_meet_head_on(open_world, policy, outcome):
    a, z = [1.0, 0.0, 2.0], [9.0, 0.4, 2.0]
    scenario = Scenario(timeout=12.0, policy=policy_named(policy), start_radius=0.0)
    builder = DiagramBuilder()
    there, back = replace(scenario, start=a, goal=z), replace(scenario, start=z, goal=a)
    one = AddFlight(builder, there, open_world, name="one", camera=False)
    AddFlight(builder, back, open_world, name="two", camera=False, others=[one])
    flights = list(fly_all(builder.Build()).values())
    for flight in flights:
        assert flight.outcome == outcome
        assert (flight.clearances.min() <= 0.0) == (outcome == Outcome.COLLISION)
    if outcome == Outcome.COLLISION:
        one_p, two_p = (flight.states[-1, :3] for flight in flights)
        assert flights[0].times[-1] == flights[1].times[-1]
        assert np.linalg.norm(one_p - two_p) == pytest.approx(2 * VEHICLE_RADIUS, abs=1e-6)


def test_vehicles_see_each_other(open_world):
    scenario = Scenario(start_radius=0.0, policy=policy_named("reactive"))
    back = replace(scenario, start=[3.0, 0.0, 2.0], goal=[1.0, 0.0, 2.0])
    builder = DiagramBuilder()
    one = AddFlight(builder, scenario, open_world)
    two = AddFlight(builder, back, open_world, name="two", others=[one])
    root = builder.Build().CreateDefaultContext()

    def value(port):
        return port.Eval(port.get_system().GetMyContextFromRoot(root))

    for parts in (one, two):
        depth = value(parts.camera.depth_image_32f_output_port()).data[120, 160, 0]
        assert depth == pytest.approx(1.9 - 0.25 * VEHICLE_RADIUS, abs=0.1)
        assert value(parts.camera.label_image_output_port()).data[120, 160, 0] == 0
        image = value(parts.observation["depth_image_32f"]).data[..., 0]
        assert np.isclose(image, depth, atol=0.1).any()
        clearance = value(parts.collision.GetOutputPort("clearance"))[0]
        assert clearance <= 2.0 - 2 * VEHICLE_RADIUS + 1e-9
    with pytest.raises(InfeasibleFlightError, match="starts of three and flight must be >"):
        AddFlight(DiagramBuilder(), scenario, open_world, name="three", others=[one])


def test_meshcat_draws_each_flight_by_its_own_systems(open_world):
    meshcat, builder, drawn = Meshcat(), DiagramBuilder(), {}
    for name, policy, draw in (
        ("flight", "planner", ["waypoint"]),
        ("two", "planner", ["waypoint"]),
        ("three", "reactive", ["frustum"]),
    ):
        start = [1.0, {"flight": -2.0, "two": 0.0, "three": 2.0}[name], 2.0]
        scenario = Scenario(start_radius=0.0, policy=policy_named(policy), start=start)
        others = [drawn["flight"]] if name == "two" else []
        drawn[name] = AddFlight(builder, scenario, open_world, name=name, others=others)
        AddMeshcat(builder, drawn[name], meshcat, draw)
    with pytest.raises(ValueError, match="camera of AddFlight must be True"):
        AddMeshcat(builder, drawn["two"]._replace(camera=None), meshcat)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    diagram.ForcedPublish(root)
    visualizer = diagram.GetSubsystemByName("two_flight_visualizer")
    waypoint = visualizer.GetInputPort("waypoint").Eval(visualizer.GetMyContextFromRoot(root))
    assert abs(waypoint[1]) < 0.5 < waypoint[0]
    assert meshcat.HasPath("/splatpilot/three/vehicle/policy_camera/frustum")
    assert meshcat.HasPath("/splatpilot/two/moving/0")  # the vehicle of the flight `flight`


def test_spheres_of_a_scenario_move(post_world):
    path = {"waypoints": [[1.0, 0.0, 4.0], [1.0, 0.0, 1.0]], "radius": 0.5, "speed": 2.0}
    text = f"moving: {{ball: {json.dumps(path)}}}"
    scenario = parse_config(hovering(), text, "text")
    assert parse_config(Scenario(), dump_config(scenario), "dump").moving == scenario.moving
    flight = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    assert flight.outcome == Outcome.COLLISION
    assert flight.times[-1] == pytest.approx((2.0 - 0.5 - VEHICLE_RADIUS) / 2.0, abs=0.03)


@pytest.mark.parametrize(
    ("field", "value"), [("radius", 0.0), ("speed", -1.0), ("waypoints", [[1.0, 2.0]])]
)
def test_invalid_spheres_are_named(field, value):
    scenario = Scenario(moving={"ball": MovingSphere(**{field: value})})
    with pytest.raises(ValueError, match=rf"moving\.ball\.{field} must be .*, got"):
        scenario.validate()
