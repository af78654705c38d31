import copy

import baked_scenes
import numpy as np
import pytest
from pydrake import geometry
from pydrake.geometry import Box, GeometryId, RenderEngine, RenderEngineVtkParams, RenderLabel
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems import sensors
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.lens import pixel_slopes
from splatpilot.systems.splats.moving_bodies import Bodies
from splatpilot.systems.splats.render_engine import (
    ObstacleGeometry,
    SplatRenderEngine,
    gaussian_properties,
)
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera

pytestmark = pytest.mark.usefixtures("opengl")

WIDTH, HEIGHT = 32, 24
INFO = sensors.CameraInfo(WIDTH, HEIGHT, fov_y=np.pi / 2)
BACKGROUND = (0.2, 0.4, 0.6)
BOX_LABEL = RenderLabel(7)
UNSPECIFIED, EMPTY = int(RenderLabel.kUnspecified), int(RenderLabel.kEmpty)
CENTER, CORNER, OTHER_CORNER = (HEIGHT // 2, WIDTH // 2), (1, 1), (1, WIDTH - 2)
CORE = geometry.RenderCameraCore(
    "splats", INFO, geometry.ClippingRange(0.01, 100.0), RigidTransform()
)
COLOR_CAMERA = geometry.ColorRenderCamera(CORE)


class CountingScene(BakedScene):
    renders = 0

    def render(self, *args, **kwargs):
        self.renders += 1
        return super().render(*args, **kwargs)


def wall(z: float, opacity: float = 0.99) -> CountingScene:
    return CountingScene(baked_scenes.wall(2, z, opacity))


def depth_camera(min_depth: float = 0.1, max_depth: float = 50.0) -> geometry.DepthRenderCamera:
    return geometry.DepthRenderCamera(CORE, geometry.DepthRange(min_depth, max_depth))


def rgbd_sensor() -> sensors.RgbdSensor:
    world = geometry.SceneGraph.world_frame_id()
    return sensors.RgbdSensor(world, RigidTransform(), COLOR_CAMERA, depth_camera())


def green() -> geometry.PerceptionProperties:
    properties = geometry.PerceptionProperties()
    properties.AddProperty("phong", "diffuse", geometry.Rgba(0, 1, 0, 1))
    properties.AddProperty("label", "id", BOX_LABEL)
    return properties


def add_box(engine: RenderEngine, z: float) -> GeometryId:
    id = GeometryId.get_new_id()
    assert engine.RegisterVisual(id, Box(1, 1, 1), green(), RigidTransform([0, 0, z + 0.5]), True)
    return id


def color(engine: RenderEngine) -> np.ndarray:
    image = sensors.ImageRgba8U(WIDTH, HEIGHT)
    engine.RenderColorImage(COLOR_CAMERA, image)
    return image.data.astype(int)


def depth(engine: RenderEngine, *depth_range: float) -> np.ndarray:
    image = sensors.ImageDepth32F(WIDTH, HEIGHT)
    engine.RenderDepthImage(depth_camera(*depth_range), image)
    return image.data[..., 0].copy()


def label(engine: RenderEngine) -> np.ndarray:
    image = sensors.ImageLabel16I(WIDTH, HEIGHT)
    engine.RenderLabelImage(COLOR_CAMERA, image)
    return image.data[..., 0].copy()


def is_green(rgba: np.ndarray) -> bool:
    return bool(rgba[1] > 100 and rgba[0] < 30 and rgba[2] < 30)


def is_orange(rgba: np.ndarray) -> bool:
    return bool(np.allclose(rgba, [255, 127.5, 0, 255], atol=4))


def test_box_before_the_wall_is_seen_in_the_depth_range():
    engine = SplatRenderEngine(wall(4.0), background=BACKGROUND)
    add_box(engine, 2.0)
    assert is_green(color(engine)[CENTER]) and is_orange(color(engine)[CORNER])
    assert label(engine)[CENTER] == int(BOX_LABEL) and label(engine)[CORNER] == UNSPECIFIED
    for depth_range, center, corner in (
        ((0.1, 50.0), 2.0, 4.0),
        ((3.0, 5.0), 0.0, 4.0),
        ((0.1, 3.0), 2.0, np.inf),
        ((5.0, 9.0), 0.0, 0.0),
        ((0.1, 1.0), np.inf, np.inf),
    ):
        image = depth(engine, *depth_range)
        assert image[CENTER] == pytest.approx(center, abs=1e-4)
        assert image[CORNER] == pytest.approx(corner, rel=2e-3)


def test_depth_is_the_minimum():
    engine = SplatRenderEngine(wall(4.0))
    alone = geometry.MakeRenderEngineVtk(RenderEngineVtkParams())
    for target in (engine, alone):
        # This rotated box pierces the wall.
        X_WG = RigidTransform(RotationMatrix.MakeYRotation(0.6), [0.3, 0, 4.5])
        target.RegisterVisual(GeometryId.get_new_id(), Box(2, 2, 2), green(), X_WG, True)
    splats = SplatCamera(wall(4.0), INFO).render(RigidTransform()).depth
    shapes = depth(alone)
    assert np.any(shapes < splats) and np.any(shapes > splats)
    np.testing.assert_array_equal(depth(engine), np.minimum(shapes, splats))


def test_nothing_in_view_is_background():
    params = RenderEngineVtkParams(default_clear_color=[1, 0, 1])
    engine = SplatRenderEngine(wall(-4.0), geometry.MakeRenderEngineVtk(params))
    assert np.all(color(engine) == [255, 0, 255, 255])
    engine = SplatRenderEngine(wall(-4.0), background=BACKGROUND)
    assert np.all(color(engine) == [51, 102, 153, 255])
    assert np.all(depth(engine) == np.inf) and np.all(label(engine) == EMPTY)


def test_shapes_shine_through_thin_gaussians():
    scene = wall(3.0, opacity=0.05)
    engine, alone = SplatRenderEngine(scene), SplatRenderEngine(wall(-4.0))
    for target in (engine, alone):
        add_box(target, 5.0)
    view = scene.render(INFO.intrinsic_matrix(), WIDTH, HEIGHT, RigidTransform())
    alpha = view.alpha[CENTER]
    assert 0.1 < alpha < 0.5
    expected = 255 * view.color[CENTER] + (1 - alpha) * color(alone)[CENTER][:3]
    np.testing.assert_allclose(color(engine)[CENTER][:3], expected, atol=1)
    assert depth(engine)[CENTER] == pytest.approx(5.0, abs=1e-4)
    assert label(engine)[CENTER] == int(BOX_LABEL) and label(engine)[CORNER] == EMPTY


@pytest.mark.parametrize("duplicate", [copy.deepcopy, RenderEngine.Clone])
def test_copies_share_the_scene_and_nothing_else(duplicate):
    engine = SplatRenderEngine(wall(4.0))
    id = add_box(engine, 2.0)
    other = duplicate(engine)
    assert isinstance(other, SplatRenderEngine) and other.scene is engine.scene
    for image in (color, depth, label):
        np.testing.assert_array_equal(image(other), image(engine))
    other.UpdateViewpoint(RigidTransform([0, 0, 1.0]))
    assert depth(other)[CENTER] == pytest.approx(1.0, abs=1e-4)
    assert other.RemoveGeometry(id) and not other.has_geometry(id)
    assert not other.RemoveGeometry(id)
    assert depth(other)[CENTER] == pytest.approx(3.0, rel=2e-3)
    assert depth(engine)[CENTER] == pytest.approx(2.0, abs=1e-4)
    other.RegisterVisual(id, Box(1, 1, 1), green(), RigidTransform([0, 0, 3.5]), True)
    assert depth(other)[CENTER] == pytest.approx(2.0, abs=1e-4)


def test_an_environment_is_behind_everything():
    texels = np.zeros((4, 8, 3), np.float32)
    texels[:2], texels[2:] = (0.2, 0.4, 0.6), (0.8, 0.1, 0.2)
    environment = EnvironmentMap(texels)
    engine = SplatRenderEngine(wall(-4.0), background=environment)
    add_box(engine, 3.0)
    rows, columns = np.array([CORNER[0], HEIGHT - 2]), np.array([CORNER[1], WIDTH - 2])
    slopes = pixel_slopes(None, INFO.intrinsic_matrix(), WIDTH, HEIGHT)[rows, columns]
    v_W = np.column_stack([slopes, np.ones(2)])
    seen = color(engine)
    np.testing.assert_allclose(seen[rows, columns, :3] / 255, environment.color(v_W), atol=0.01)
    assert is_green(seen[CENTER])
    assert is_orange(color(SplatRenderEngine(wall(4.0), background=environment))[CENTER])


@pytest.mark.parametrize("background", [(0, 0), (0, 0, 1.5), (0, 0, np.nan)])
def test_background_must_be_a_color(background):
    with pytest.raises(ValueError, match="background must be three numbers"):
        SplatRenderEngine(wall(4.0), background=background)


def test_rgbd_sensor_sees_moving_and_anchored_shapes_that_accept_the_renderer():
    scene = wall(4.0)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    scene_graph.AddRenderer("splats", SplatRenderEngine(scene))
    visual = """
        <visual name='{name}'>
          <origin xyz='{x} -2 3.5'/><geometry><box size='2 2 1'/></geometry>
          <drake:accepting_renderer name='{name}'/>
        </visual>"""
    visuals = visual.format(name="splats", x=-3) + visual.format(name="other", x=3)
    urdf = f"<robot name='props'><link name='world'>{visuals}</link></robot>"
    Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.Finalize()
    source = scene_graph.RegisterSource("test")
    frame = scene_graph.RegisterFrame(source, geometry.GeometryFrame("moving"))
    moving = geometry.GeometryInstance(RigidTransform([0, 0, 0.5]), Box(1, 1, 1), "moving")
    moving.set_perception_properties(green())
    scene_graph.RegisterGeometry(source, frame, moving)
    sensor = builder.AddSystem(rgbd_sensor())
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    builder.ExportInput(scene_graph.get_source_pose_port(source), "poses")
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    for z, box_is_seen in ((2.0, True), (3.0, True), (6.0, False)):
        poses = geometry.FramePoseVector()
        poses.set_value(frame, RigidTransform([0, 0, z]))
        diagram.GetInputPort("poses").FixValue(root, poses)
        rgb, meters, millimeters, labels = (
            sensor.GetOutputPort(name).Eval(sensor.GetMyContextFromRoot(root)).data.squeeze()
            for name in ("color_image", "depth_image_32f", "depth_image_16u", "label_image")
        )
        assert is_green(rgb[CENTER]) == box_is_seen
        assert (labels[CENTER] == int(BOX_LABEL)) == box_is_seen
        assert meters[CENTER] == pytest.approx(z if box_is_seen else 4.0, rel=2e-3)
        assert meters[CORNER] == pytest.approx(3.0, rel=1e-4)
        assert meters[OTHER_CORNER] == pytest.approx(4.0, rel=2e-3)
        np.testing.assert_allclose(millimeters, meters * 1000, atol=1)
    assert scene.renders == 1


def disc() -> GaussianScene:
    return baked_scenes.uniform_scene(np.zeros((1, 3)), [0.4, 0.4, 0.001], color=(1.0, 0, 0))


def test_a_geometry_is_drawn_as_gaussians_at_its_pose():
    engine = SplatRenderEngine(wall(4.0))
    id, pose = GeometryId.get_new_id(), RigidTransform([0.0, 0.0, 2.0])
    properties = gaussian_properties(disc(), label=RenderLabel(3))
    engine.RegisterVisual(id, Box(1, 1, 1), properties, pose)
    for copied in (engine, copy.deepcopy(engine)):
        copied.UpdateViewpoint(RigidTransform())
        assert depth(copied)[CENTER] == pytest.approx(2.0, abs=0.01)
        assert label(copied)[CENTER] == 3
        assert label(copied)[CORNER] == UNSPECIFIED
        copied.DoUpdateVisualPose(id, RigidTransform([0.0, 0.0, 3.0]))
        assert depth(copied)[CENTER] == pytest.approx(3.0, abs=0.01)
        copied.DoUpdateVisualPose(id, RigidTransform([1e9, 0.0, 3.0]))
        assert depth(copied)[CENTER] == pytest.approx(4.0, rel=2e-3)
    assert engine.RemoveGeometry(id)
    assert label(engine)[CENTER] == UNSPECIFIED
    # Another body at the same pose.
    for value in (1, 2):
        id = GeometryId.get_new_id()
        properties = gaussian_properties(disc(), label=RenderLabel(value))
        engine.RegisterVisual(id, Box(1, 1, 1), properties, pose)
        assert label(engine)[CENTER] == value
        assert engine.RemoveGeometry(id)


@pytest.mark.parametrize("time", [0.0, 3.0])
def test_moving_obstacles_are_seen_as_by_a_splat_camera(time):
    path = [[0.0, 0.0, 2.0], [0.0, 0.0, 2.5], [0.0, 0.0, 3.0], [np.inf] * 3]
    obstacles = baked_scenes.moving(disc(), path, radius=0.4)
    scene, builder = baked_scenes.wall(2, 4.0), DiagramBuilder()
    scene_graph = builder.AddSystem(geometry.SceneGraph())
    scene_graph.AddRenderer("splats", SplatRenderEngine(scene))
    ObstacleGeometry.AddToBuilder(builder, scene_graph, obstacles)
    sensor = builder.AddSystem(rgbd_sensor())
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    root = builder.Build().CreateDefaultContext()
    root.SetTime(time)
    image = sensor.depth_image_32F_output_port().Eval(sensor.GetMyContextFromRoot(root)).data
    seen = SplatCamera(scene, INFO).render(RigidTransform(), Bodies(time, obstacles)).depth
    np.testing.assert_allclose(image[..., 0], seen, rtol=1e-5)
    assert image[CENTER][0] == pytest.approx(2.0 if time == 0.0 else 4.0, rel=2e-3)
