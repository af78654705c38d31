"""Drawings in Meshcat, read back."""

import base64
import json

import cv2
import msgpack
import numpy as np
import pytest
from baked_scenes import uniform_scene
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, TrajectorySource
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
from pydrake.trajectories import PiecewisePolynomial

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.shapes import AnalyticDistanceField, MovingSpheres, Sphere
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.moving_bodies import MovingBodies, MovingObstacles
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import StateToPose
from splatpilot.systems.visualization.flight_visualizer import (
    DRAWINGS,
    FlightVisualizer,
    fan_mesh,
    hypothesis_colors,
)
from splatpilot.systems.visualization.meshcat_drawing import (
    CameraVisualizer,
    MovingBodiesVisualizer,
    draw_distance_slice,
    draw_gaussians,
    draw_goal,
    picture_gltf,
)
from splatpilot.systems.visualization.video import VideoRecorder


@pytest.fixture(scope="module")
def shared_meshcat():
    return Meshcat()


@pytest.fixture
def meshcat(shared_meshcat):
    shared_meshcat.Delete("/splatpilot")
    return shared_meshcat


def position(meshcat, path: str) -> list[float]:
    """The position of a path in its parent [m]."""
    return msgpack.unpackb(meshcat._GetPackedTransform(path))["matrix"][12:15]


def drawn(meshcat, path: str) -> dict:
    """The object at a path, as the page gets it: its geometry, its material and itself."""
    return msgpack.unpackb(meshcat._GetPackedObject(path))["object"]


def vertices(meshcat, path: str, attribute: str = "position") -> np.ndarray:
    """(n, 3) An attribute of the vertices of a drawing: position [m] or color."""
    packed = drawn(meshcat, path)["geometries"][0]["data"]["attributes"][attribute]["array"]
    return np.frombuffer(packed.data, "<f4").reshape(-1, 3)


def test_flight_is_drawn_with_its_trail_and_plan(meshcat):
    waypoints_B = np.cumsum(np.full((3, 10, 3), 0.1), axis=1)
    plan = Hypotheses(0.0, RigidTransform([1, 0, 2]), waypoints_B, np.array([1.0, 2.0, 3.0]))
    ends = [hover_state([x, 0, 2]) for x in (1, 3)]
    builder = DiagramBuilder()
    motion = PiecewisePolynomial.FirstOrderHold([0.0, 1.0], np.column_stack(ends))
    state = builder.AddSystem(TrajectorySource(motion))
    hypotheses = builder.AddSystem(ConstantVectorSource(plan.to_vector()))
    visualizer = builder.AddSystem(FlightVisualizer(meshcat, num_hypotheses=3, period=0.1))
    builder.Connect(state.get_output_port(), visualizer.GetInputPort("state"))
    builder.Connect(hypotheses.get_output_port(), visualizer.GetInputPort("hypotheses"))
    Simulator(builder.Build()).AdvanceTo(0.35)
    assert meshcat.HasPath("/splatpilot/vehicle/body")
    trail = vertices(meshcat, "/splatpilot/trail")
    np.testing.assert_allclose(trail, [[1 + 0.2 * k, 0, 2] for k in range(4)], atol=1e-6)
    assert len(vertices(meshcat, "/splatpilot/hypotheses")) == 3 * 11 * 2


def test_visualizers_of_two_vehicles_draw_by_forced_publish(meshcat):
    builder = DiagramBuilder()
    scene = uniform_scene([[3.0, 0, 1]], [0.3] * 3)
    for k, prefix in enumerate(("", "b_")):
        source = ConstantVectorSource(hover_state([k, 0, 1]))
        plant = builder.AddNamedSystem(f"{prefix}plant", source)
        pose = builder.AddSystem(StateToPose())
        camera = SplatCamera(scene, CameraInfo(32, 24, 1.0), RigidTransform())
        builder.AddNamedSystem(f"{prefix}camera", camera)
        builder.Connect(plant.get_output_port(), pose.get_input_port())
        builder.Connect(pose.get_output_port(), camera.GetInputPort("body_pose"))
        FlightVisualizer.AddToBuilder(builder, plant.get_output_port(), meshcat)
        CameraVisualizer.AddToBuilder(builder, camera, meshcat, depth=True)
        VideoRecorder.AddToBuilder(builder, camera, 15.0)
    spheres = MovingSpheres([0.5], [np.array([[float(k), 0, 1] for k in range(20)])], 0.1)
    add_moving(builder, MovingBodiesVisualizer(meshcat), spheres)
    diagram = builder.Build()
    assert diagram.HasSubsystemNamed("b_flight_visualizer") and diagram.HasSubsystemNamed("video")
    context = diagram.CreateDefaultContext()
    context.SetTime(16 / 15)  # not a multiple of the stride
    diagram.ForcedPublish(context)
    assert position(meshcat, "/splatpilot/moving/0") == [10, 0, 1]
    assert position(meshcat, "/splatpilot/vehicle") == [0, 0, 1]
    assert position(meshcat, "/splatpilot/b/vehicle") == [1, 0, 1]
    for name in ("picture", "frustum", "depth"):
        assert meshcat.HasPath(f"/splatpilot/b/vehicle/camera/{name}")


def test_depth_points_lie_along_the_rays_of_the_lens(meshcat):
    builder = DiagramBuilder()
    info = CameraInfo(64, 48, 20.0, 20.0, 32.0, 24.0)
    scene, lens = uniform_scene([[2.0, 0, 2]], [0.1] * 3), Distortion(model="fisheye")
    camera = builder.AddNamedSystem("camera", SplatCamera(scene, info, distortion=lens))
    CameraVisualizer.AddToBuilder(builder, camera, meshcat, depth=True)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    pose = camera.GetInputPort("body_pose")
    pose.FixValue(camera.GetMyMutableContextFromRoot(context), RigidTransform())
    diagram.ForcedPublish(context)
    points = vertices(meshcat, "/splatpilot/vehicle/camera/depth")
    np.testing.assert_allclose(points.mean(axis=0), [2, 0, 2], atol=0.1)


def test_arrows_are_drawn_on_request(meshcat):
    values = {"command": [9.81, 0.2, 0, 0], "waypoint": [2.0, 0, 1]}
    values |= {"distance": [2.0], "gradient": [0, 1.0, 0], "barrier": [0.5]}
    builder = DiagramBuilder()
    ports = {
        name: builder.AddSystem(ConstantVectorSource(value)).get_output_port()
        for name, value in values.items()
    }
    x = hover_state([1, 0, 1])
    x[3:6] = 2, 0, 0
    plant = builder.AddNamedSystem("plant", ConstantVectorSource(x))
    options = {"draw": [*DRAWINGS, "axes"], "sources": ports}
    FlightVisualizer.AddToBuilder(builder, plant.get_output_port(), meshcat, **options)
    diagram = builder.Build()
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    for name, tip in {
        "velocity": [2, 0, 1],
        "thrust": [1, 0, 1.981],
        "rates": [1.1, 0, 1],
        "waypoint": [2, 0, 1],
        "nearest": [1, -2, 1],
        "barrier": [1, 0.5, 1],
    }.items():
        arrow = vertices(meshcat, f"/splatpilot/{name}")
        np.testing.assert_allclose(arrow, [[1, 0, 1], tip], atol=1e-6)
    assert meshcat.HasPath("/splatpilot/vehicle/axes/z")
    with pytest.raises(ValueError, match=r"draw must be names of velocity, .*, got wings"):
        FlightVisualizer(meshcat, draw=["wings"])
    with pytest.raises(ValueError, match="sources must be with command"):
        port = plant.get_output_port()
        FlightVisualizer.AddToBuilder(DiagramBuilder(), port, meshcat, draw=["thrust"])


def test_fan_is_ribbons_along_the_plans_in_the_colors_of_their_costs():
    generator = np.random.default_rng(0)
    waypoints_B = np.cumsum(generator.uniform(-0.1, 0.4, (4, 10, 3)), axis=1)
    X_WB = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1, 2, 3])
    plan = Hypotheses(0.0, X_WB, waypoints_B, np.array([2.0, 1.0, 4.0, 3.0]))
    points, faces, colors = fan_mesh(plan)
    sides = points.T.reshape(4, 11, 2, 3)
    np.testing.assert_allclose(sides.mean(axis=2)[:, 1:], plan.waypoints_W, atol=1e-12)
    np.testing.assert_allclose(sides.mean(axis=2)[:, 0], np.tile([1, 2, 3], (4, 1)))
    across = sides[:, :, 1] - sides[:, :, 0]
    np.testing.assert_allclose(np.linalg.norm(across, axis=-1), 0.02)
    np.testing.assert_allclose(across[..., 2], 0, atol=1e-12)
    shades = colors.T.reshape(4, 22, 3)
    assert (shades == shades[:, :1]).all()
    np.testing.assert_allclose(shades[[1, 2], 0], [[0, 1, 0.1], [1, 0, 0.1]])
    assert faces.min() == 0 and faces.max() == 4 * 22 - 1
    assert (faces // 22 == faces[0] // 22).all()
    colors = hypothesis_colors(np.array([1.0, 2.0, np.inf]))
    np.testing.assert_allclose(colors, [[0, 1, 0.1], [1, 0, 0.1], [1, 0, 0.1]])


def add_moving(builder, visualizer, spheres):
    gaussians = uniform_scene([[0.0, 0, 0]], [0.1] * 3)
    obstacles = MovingObstacles(spheres, [gaussians] * len(spheres.radii))
    moving = builder.AddSystem(MovingBodies(obstacles))
    builder.AddSystem(visualizer)
    builder.Connect(moving.get_output_port(), visualizer.get_input_port())
    return moving


def test_moving_bodies_are_drawn(meshcat):
    paths = [np.array([[1.0, 2, 3], [2, 2, 3], [4, 2, 3]]), np.array([[0.0, 0, 1], [np.inf] * 3])]
    spheres = MovingSpheres([0.5, 0.25], paths, period=0.1)
    builder = DiagramBuilder()
    moving = add_moving(builder, MovingBodiesVisualizer(meshcat, period=0.1), spheres)
    port = moving.DeclareBody("bird", uniform_scene([[0.0, 0, 0.5]], [0.1] * 3), 0.1)
    X_WO = RigidTransform(RollPitchYaw(0, 0, 1), [7.0, 8, 9])
    pose = builder.AddSystem(ConstantValueSource(Value(X_WO)))
    builder.Connect(pose.get_output_port(), port)
    simulator = Simulator(builder.Build())
    for time, expected in ((0.15, [[2, 2, 3], [0, 0, -1000]]), (0.25, [[4, 2, 3], [0, 0, 1]])):
        simulator.AdvanceTo(time)
        for k, p_WO in enumerate([*expected, [7, 8, 9]]):
            assert position(meshcat, f"/splatpilot/moving/{k}") == p_WO
    assert drawn(meshcat, "/splatpilot/moving/1")["geometries"][0]["radius"] == 0.25
    assert drawn(meshcat, "/splatpilot/moving/2")["object"]["type"] == "Points"


def test_gaussians_are_drawn_as_points_of_their_size(meshcat):
    scales = np.array([[0.1, 0.02, 0.01], [0.01, 0.3, 0.1], [9, 9, 9]])
    colors = np.array([[1.0, 0.5, 0.0], [0.2, 0.2, 0.8], [1, 1, 1]])
    scene = uniform_scene([[1, 0, 1], [2, 0.5, 1], [100, 0, 1]], scales, color=colors)
    draw_gaussians(meshcat, "/splatpilot/scene", scene, np.zeros(3) - 1, np.full(3, 4.0))
    points = vertices(meshcat, "/splatpilot/scene")
    np.testing.assert_array_equal(points, [[1, 0, 1], [2, 0.5, 1]])
    shown = vertices(meshcat, "/splatpilot/scene", "color") ** (1 / 2.2)  # as the screen encodes it
    np.testing.assert_allclose(shown, colors[:2], atol=0.02)
    # As wide as the median over Gaussians of their largest deviations, 0.1 m and 0.3 m.
    size = drawn(meshcat, "/splatpilot/scene")["materials"][0]["size"]
    assert size == pytest.approx(2 * 0.2)


def test_many_gaussians_are_thinned_evenly(meshcat):
    x = np.arange(301.0)
    scene, box = uniform_scene(np.column_stack([x, 0 * x, 0 * x]), [0.1] * 3), np.full(3, 1e3)
    draw_gaussians(meshcat, "/splatpilot/scene", scene, -box, box, max_points=101)
    np.testing.assert_array_equal(vertices(meshcat, "/splatpilot/scene")[:, 0], x[::3])


def test_goal_is_a_sphere_at_its_position(meshcat):
    draw_goal(meshcat, "/splatpilot/goal", np.array([3.0, -1.0, 2.0]), radius=0.3)
    drawing = drawn(meshcat, "/splatpilot/goal")
    assert drawing["geometries"][0]["radius"] == 0.3
    assert drawing["materials"][0]["transparent"]
    assert position(meshcat, "/splatpilot/goal") == [3.0, -1.0, 2.0]


def test_distance_slice_is_colored_by_distance(meshcat):
    field = AnalyticDistanceField([Sphere([2, 0, 1], 0.5)], [0, -1, 0], [6, 1, 2])
    draw_distance_slice(meshcat, "/splatpilot/slice", field, height=1.0)
    drawing = drawn(meshcat, "/splatpilot/slice")
    p, color = (vertices(meshcat, "/splatpilot/slice", name) for name in ("position", "color"))
    index = np.frombuffer(drawing["geometries"][0]["data"]["index"]["array"].data, "<u4")
    a, b, c = np.moveaxis(p[index].reshape(-1, 3, 3), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(6 * 2, rel=5e-3)
    assert (p[:, 2] == 1).all()
    distance = np.linalg.norm(p - [2, 0, 1], axis=1) - 0.5
    assert (distance < 0).any() and (distance > 2).any()
    np.testing.assert_allclose(color[distance < 0], np.tile([1, 0, 0], (sum(distance < 0), 1)))
    np.testing.assert_allclose(color[distance > 2], np.tile([0, 0, 1], (sum(distance > 2), 1)))
    about_1 = color[abs(distance - 1) < 0.05]
    assert len(about_1) and (about_1[:, :2] > 0.9).all() and (about_1[:, 2] < 0.3).all()

    class Unknown(AnalyticDistanceField):
        def query(self, p_WQ):
            sample = super().query(p_WQ)
            sample.state[...] = FieldState.UNKNOWN
            return sample

    unknown = Unknown([], [0, -1, 0], [6, 1, 2])
    draw_distance_slice(meshcat, "/splatpilot/slice", unknown, height=1.0)
    np.testing.assert_allclose(vertices(meshcat, "/splatpilot/slice", "color"), 0.4)


def test_camera_picture_is_shown_at_its_rate(meshcat):
    info = CameraInfo(width=32, height=24, fov_y=1.0)
    builder = DiagramBuilder()
    shown_at = []

    class Image(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareAbstractOutputPort("image", lambda: Value(ImageRgba8U(32, 24)), self._note)

        def _note(self, context, value):
            shown_at.append(context.get_time())

    image = builder.AddSystem(Image())
    picture = builder.AddSystem(CameraVisualizer(meshcat, info, RigidTransform(), 0.1, stride=2))
    builder.Connect(image.get_output_port(), picture.GetInputPort("color_image"))
    Simulator(builder.Build()).AdvanceTo(0.5)
    assert meshcat.HasPath("/splatpilot/vehicle/camera/frustum")
    assert meshcat.HasPath("/splatpilot/vehicle/camera/picture")
    assert shown_at == pytest.approx([0.0, 0.2, 0.4])


def test_picture_document_is_the_picture():
    rgb = np.zeros((24, 32, 3), np.uint8)
    rgb[:12, :, 0] = 250
    corners = np.array([[-1.0, -2, 3], [1, -2, 3], [1, 2, 3], [-1, 2, 3]])
    document = json.loads(picture_gltf(rgb, corners))

    def data(uri: str) -> np.ndarray:
        return np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8)

    decoded = cv2.imdecode(data(document["images"][0]["uri"]), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - rgb).mean() < 3
    binary = data(document["buffers"][0]["uri"])
    assert len(binary) == document["buffers"][0]["byteLength"]
    positions = binary[:48].view("<f4").reshape(4, 3)
    # glTF's (x, y, z) is Drake's (x, -z, y).
    drake = np.column_stack([positions[:, 0], -positions[:, 2], positions[:, 1]])
    np.testing.assert_allclose(drake, corners)
