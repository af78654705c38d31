import copy

import baked_scenes
import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    FramePoseVector,
    GeometryFrame,
    GeometryId,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngine,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import (
    CameraInfo,
    ImageDepth32F,
    ImageLabel16I,
    ImageRgba8U,
    RgbdSensor,
)

from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.splats.background import EnvironmentMap, pixel_rays
from splatpilot.systems.splats.baked_scene import BakedScene, MovingGaussians
from splatpilot.systems.splats.moving_bodies import Bodies, MovingObstacles
from splatpilot.systems.splats.render_engine import (
    ObstacleGeometry,
    SplatRenderEngine,
    gaussian_properties,
)
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera

pytestmark = pytest.mark.usefixtures("opengl")

WIDTH, HEIGHT = 32, 24
INFO = CameraInfo(WIDTH, HEIGHT, fov_y=np.pi / 2)
BACKGROUND = (0.2, 0.4, 0.6)
BOX_LABEL = RenderLabel(7)
UNSPECIFIED, EMPTY = int(RenderLabel.kUnspecified), int(RenderLabel.kEmpty)
CENTER = HEIGHT // 2, WIDTH // 2
CORNER = 1, 1


class CountingScene(BakedScene):
    renders = 0

    def render(self, *args, **kwargs):
        self.renders += 1
        return super().render(*args, **kwargs)


def wall(z: float, opacity: float = 0.99) -> CountingScene:
    return CountingScene(baked_scenes.wall(2, z, opacity))


def core(near: float = 0.01, far: float = 100.0, name: str = "splats") -> RenderCameraCore:
    return RenderCameraCore(name, INFO, ClippingRange(near, far), RigidTransform())


COLOR_CAMERA = ColorRenderCamera(core())


def depth_camera(min_depth: float = 0.1, max_depth: float = 50.0) -> DepthRenderCamera:
    return DepthRenderCamera(core(), DepthRange(min_depth, max_depth))


def green() -> PerceptionProperties:
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", Rgba(0, 1, 0, 1))
    properties.AddProperty("label", "id", BOX_LABEL)
    return properties


def add_box(engine: RenderEngine, z: float) -> GeometryId:
    id = GeometryId.get_new_id()
    X_WG = RigidTransform([0, 0, z + 0.5])
    assert engine.RegisterVisual(id, Box(1, 1, 1), green(), X_WG, True)
    return id


def color(engine: RenderEngine) -> np.ndarray:
    image = ImageRgba8U(WIDTH, HEIGHT)
    engine.RenderColorImage(COLOR_CAMERA, image)
    return image.data.astype(int)


def depth(engine: RenderEngine, camera: DepthRenderCamera | None = None) -> np.ndarray:
    image = ImageDepth32F(WIDTH, HEIGHT)
    engine.RenderDepthImage(camera or depth_camera(), image)
    return image.data[..., 0].copy()


def label(engine: RenderEngine) -> np.ndarray:
    image = ImageLabel16I(WIDTH, HEIGHT)
    engine.RenderLabelImage(COLOR_CAMERA, image)
    return image.data[..., 0].copy()


def is_green(rgba: np.ndarray) -> bool:
    return bool(rgba[1] > 100 and rgba[0] < 30 and rgba[2] < 30)


def is_orange(rgba: np.ndarray) -> bool:
    return bool(np.allclose(rgba, [255, 127.5, 0, 255], atol=4))


def test_box_before_the_wall_is_seen():
    engine = SplatRenderEngine(wall(4.0), background=BACKGROUND)
    add_box(engine, 2.0)
    assert is_green(color(engine)[CENTER]) and is_orange(color(engine)[CORNER])
    assert depth(engine)[CENTER] == pytest.approx(2.0, abs=1e-4)
    assert depth(engine)[CORNER] == pytest.approx(4.0, rel=2e-3)
    assert label(engine)[CENTER] == int(BOX_LABEL) and label(engine)[CORNER] == UNSPECIFIED


def test_depth_is_the_minimum():
    engine = SplatRenderEngine(wall(4.0))
    alone = MakeRenderEngineVtk(RenderEngineVtkParams())
    for target in (engine, alone):
        id = GeometryId.get_new_id()
        # This rotated box pierces the wall.
        X_WG = RigidTransform(RotationMatrix.MakeYRotation(0.6), [0.3, 0, 4.5])
        target.RegisterVisual(id, Box(2, 2, 2), green(), X_WG, True)
    camera = SplatCamera(wall(4.0), INFO, min_depth=0.1, max_depth=50.0)
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, RigidTransform())
    splats = camera.GetOutputPort("depth_image_32f").Eval(context).data[..., 0]
    shapes = depth(alone)
    assert np.any(shapes < splats) and np.any(shapes > splats)
    np.testing.assert_array_equal(depth(engine), np.minimum(shapes, splats))


def test_out_of_range_reads_as_in_drake():
    engine = SplatRenderEngine(wall(4.0))
    add_box(engine, 2.0)
    assert depth(engine, depth_camera(3.0, 5.0))[CENTER] == 0.0
    assert depth(engine, depth_camera(0.1, 3.0))[CENTER] == pytest.approx(2.0, abs=1e-4)
    assert depth(engine, depth_camera(0.1, 3.0))[CORNER] == np.inf
    assert np.all(depth(engine, depth_camera(5.0, 9.0)) == 0.0)
    assert np.all(depth(engine, depth_camera(0.1, 1.0)) == np.inf)


def test_nothing_in_view_is_background():
    params = RenderEngineVtkParams(default_clear_color=[1, 0, 1])
    engine = SplatRenderEngine(wall(-4.0), MakeRenderEngineVtk(params))
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


def test_removed_shape_is_gone_and_can_come_back():
    engine = SplatRenderEngine(wall(4.0))
    id = add_box(engine, 2.0)
    assert depth(engine)[CENTER] < 3
    assert engine.RemoveGeometry(id) and not engine.has_geometry(id)
    assert not engine.RemoveGeometry(id)
    assert depth(engine)[CENTER] == pytest.approx(4.0, rel=2e-3)
    engine.RegisterVisual(id, Box(1, 1, 1), green(), RigidTransform([0, 0, 3.5]), True)
    assert depth(engine)[CENTER] == pytest.approx(3.0, abs=1e-4)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, RenderEngine.Clone])
def test_copies_share_the_scene_and_nothing_else(duplicate):
    engine = SplatRenderEngine(wall(4.0))
    id = add_box(engine, 2.0)
    other = duplicate(engine)
    assert isinstance(other, SplatRenderEngine) and other.scene is engine.scene
    assert other.has_geometry(id)
    for image in (color, depth, label):
        np.testing.assert_array_equal(image(other), image(engine))
    other.UpdateViewpoint(RigidTransform([0, 0, 1.0]))
    assert depth(other)[CENTER] == pytest.approx(1.0, abs=1e-4)
    assert other.RemoveGeometry(id)
    assert depth(other)[CENTER] == pytest.approx(3.0, rel=2e-3)
    assert depth(engine)[CENTER] == pytest.approx(2.0, abs=1e-4)
    assert engine.RemoveGeometry(id)
    assert depth(engine)[CENTER] == pytest.approx(4.0, rel=2e-3)


def test_an_environment_is_behind_everything():
    texels = np.zeros((4, 8, 3), np.float32)
    texels[:2], texels[2:] = (0.2, 0.4, 0.6), (0.8, 0.1, 0.2)
    environment = EnvironmentMap(texels)
    engine = SplatRenderEngine(wall(-4.0), background=environment)
    add_box(engine, 3.0)
    rows, columns = np.array([CORNER[0], HEIGHT - 2]), np.array([CORNER[1], WIDTH - 2])
    v_W = pixel_rays(INFO.intrinsic_matrix(), rows, columns, RigidTransform())
    seen = color(engine)
    np.testing.assert_allclose(seen[rows, columns, :3] / 255, environment.color(v_W), atol=0.01)
    assert is_green(seen[CENTER])
    assert is_orange(color(SplatRenderEngine(wall(4.0), background=environment))[CENTER])


@pytest.mark.parametrize("background", [(0, 0), (0, 0, 1.5), (0, 0, np.nan)])
def test_background_must_be_a_color(background):
    with pytest.raises(ValueError, match="background must be three numbers"):
        SplatRenderEngine(wall(4.0), background=background)


def test_rgbd_sensor_in_a_diagram():
    scene = wall(4.0)
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    scene_graph.AddRenderer("splats", SplatRenderEngine(scene))
    source = scene_graph.RegisterSource("test")
    frame = scene_graph.RegisterFrame(source, GeometryFrame("moving"))
    moving = GeometryInstance(RigidTransform([0, 0, 0.5]), Box(1, 1, 1), "moving")
    moving.set_perception_properties(green())
    scene_graph.RegisterGeometry(source, frame, moving)
    anchored = GeometryInstance(RigidTransform([-3.0, -2.0, 3.5]), Box(2, 2, 1), "anchored")
    anchored.set_perception_properties(green())
    scene_graph.RegisterAnchoredGeometry(source, anchored)
    sensor = builder.AddSystem(
        RgbdSensor(SceneGraph.world_frame_id(), RigidTransform(), COLOR_CAMERA, depth_camera())
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    builder.ExportInput(scene_graph.get_source_pose_port(source), "poses")
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = sensor.GetMyContextFromRoot(root)

    def see(z: float) -> dict[str, np.ndarray]:
        poses = FramePoseVector()
        poses.set_value(frame, RigidTransform([0, 0, z]))
        diagram.GetInputPort("poses").FixValue(root, poses)
        names = "color_image", "depth_image_32f", "depth_image_16u", "label_image"
        return {name: sensor.GetOutputPort(name).Eval(context).data.copy() for name in names}

    for z, box_is_seen in ((2.0, True), (3.0, True), (6.0, False)):
        images = see(z)
        assert is_green(images["color_image"][CENTER]) == box_is_seen
        assert (images["label_image"][CENTER] == int(BOX_LABEL)) == box_is_seen
        meters = images["depth_image_32f"][..., 0]
        assert meters[CENTER] == pytest.approx(z if box_is_seen else 4.0, rel=2e-3)
        assert meters[CORNER] == pytest.approx(3.0, rel=1e-4)
        np.testing.assert_allclose(images["depth_image_16u"][..., 0], meters * 1000, atol=1)
    assert scene.renders == 1


def test_shapes_that_name_their_renderer():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    scene_graph.AddRenderer("splats", SplatRenderEngine(wall(4.0)))
    visual = """
        <visual name='{name}'>
          <origin xyz='{x} 0 2.5'/>
          <geometry><box size='1 1 1'/></geometry>
          <drake:accepting_renderer name='{name}'/>
        </visual>"""
    Parser(plant).AddModelsFromString(
        "<robot name='props'><link name='world'>"
        + visual.format(name="splats", x=0)
        + visual.format(name="other", x=-2)
        + "</link></robot>",
        "urdf",
    )
    plant.Finalize()
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    image = query.RenderDepthImage(depth_camera(), SceneGraph.world_frame_id(), RigidTransform())
    assert image.data[CENTER][0] == pytest.approx(2.0, abs=1e-4)
    assert image.data[CENTER[0], 2][0] == pytest.approx(4.0, rel=2e-3)


def body_of_gaussians(x: float) -> GaussianScene:
    return GaussianScene.from_colors(
        np.array([[x, 0.0, 0.0]]), [[1.0, 0, 0, 0]], [[0.4, 0.4, 0.001]], [0.99], [[1.0, 0, 0]]
    )


def test_a_geometry_is_drawn_as_gaussians_at_its_pose():
    engine = SplatRenderEngine(wall(4.0))
    id, pose = GeometryId.get_new_id(), RigidTransform([0.0, 0.0, 2.0])
    properties = gaussian_properties(body_of_gaussians(0.0), label=RenderLabel(3))
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


def test_a_scene_is_baked():
    engine = SplatRenderEngine(body_of_gaussians(0.0))
    engine.UpdateViewpoint(RigidTransform([0.0, 0.0, -1.0]))
    assert depth(engine)[CENTER] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("time", [0.0, 3.0])
def test_moving_obstacles_are_seen_as_by_a_splat_camera(time):
    path = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 2.5], [0.0, 0.0, 3.0], [np.inf] * 3])
    spheres = MovingSpheres([0.4], [path], 1.0)
    obstacles = MovingObstacles(spheres, MovingGaussians([body_of_gaussians(0.0)], spheres.centers))
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    scene_graph.AddRenderer("splats", SplatRenderEngine(wall(4.0)))
    ObstacleGeometry.AddToBuilder(builder, scene_graph, obstacles)
    sensor = builder.AddSystem(
        RgbdSensor(SceneGraph.world_frame_id(), RigidTransform(), COLOR_CAMERA, depth_camera())
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    root = builder.Build().CreateDefaultContext()
    root.SetTime(time)
    image = sensor.depth_image_32F_output_port().Eval(sensor.GetMyContextFromRoot(root)).data
    seen = SplatCamera(wall(4.0), INFO).render(RigidTransform(), Bodies(time, obstacles)).depth
    np.testing.assert_allclose(image[..., 0], seen, rtol=1e-5)
    assert image[CENTER][0] == pytest.approx(2.0 if time == 0.0 else 4.0, rel=2e-3)
