import baked_scenes
import numpy as np
import pytest
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    RenderLabel,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from splatpilot.systems.sensing.noise import light_of_color
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.moving_bodies import Bodies
from splatpilot.systems.splats.splat_camera import SplatCamera, row_bands
from splatpilot.systems.vehicle.state import pose_between

INFO = CameraInfo(width=32, height=24, fov_y=np.pi / 2)
# Camera z along body x, as on the vehicle.
X_BC = RigidTransform(RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])), [0.1, 0, 0])


class CountingScene(BakedScene):
    colors = depths = 0

    def render_color(self, *args, **kwargs):
        self.colors += 1
        return super().render_color(*args, **kwargs)

    def render_depth(self, *args, **kwargs):
        self.depths += 1
        return super().render_depth(*args, **kwargs)


def wall(x: float, opacity: float = 0.99) -> CountingScene:
    return CountingScene(baked_scenes.wall(0, x, opacity))


def at_pose(camera: SplatCamera, X_WB: RigidTransform):
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    return context


def evaluate(camera: SplatCamera, port: str, X_WB: RigidTransform) -> np.ndarray:
    return camera.GetOutputPort(port).Eval(at_pose(camera, X_WB)).data


def test_output_ports_are_those_of_rgbd_sensor():
    core = RenderCameraCore("none", INFO, ClippingRange(0.01, 10), RigidTransform())
    cameras = ColorRenderCamera(core), DepthRenderCamera(core, DepthRange(0.1, 5))
    sensor = RgbdSensor(SceneGraph.world_frame_id(), RigidTransform(), *cameras)
    camera = SplatCamera(wall(3), INFO)
    methods = [name for name in dir(sensor) if name.endswith("_output_port") and name[:3] != "get"]
    assert len(methods) == sensor.num_output_ports()
    for name in methods:
        ours, theirs = getattr(camera, name)(), getattr(sensor, name)()
        assert ours.get_name() == theirs.get_name()
        assert ours.get_data_type() == theirs.get_data_type()
        assert type(ours.Allocate()) is type(theirs.Allocate())
    assert camera.body_pose_input_port().get_name() == "body_pose"


@pytest.mark.parametrize(
    ("x", "opacity", "meters", "millimeters", "tolerance"),
    [
        (3.0, 0.99, 2.9, 2900, 2e-3),
        (1.0, 0.99, 0.0, 0, 0),  # nearer than the range
        (9.0, 0.99, np.inf, 65535, 0),  # farther than the range
        (3.0, 0.02, np.inf, 65535, 0),  # too thin for a surface
    ],
)
def test_wall_is_seen_at_its_distance(x, opacity, meters, millimeters, tolerance):
    camera = SplatCamera(wall(x, opacity), INFO, X_BC, min_depth=2.0, max_depth=5.0)
    for port, expected in (("depth_image_32f", meters), ("depth_image_16u", millimeters)):
        image = evaluate(camera, port, RigidTransform())
        np.testing.assert_allclose(image, expected, rtol=tolerance)


def test_color_and_label_are_those_of_the_wall_or_of_the_background():
    camera = SplatCamera(wall(3), INFO, X_BC, background=(0.2, 0.4, 0.6))
    ahead, back = RigidTransform(), RigidTransform(RotationMatrix.MakeZRotation(np.pi))
    for X_WB, color, label, tolerance in (
        (ahead, [255, 127.5, 0, 255], RenderLabel.kUnspecified, 3),
        (back, [51, 102, 153, 255], RenderLabel.kEmpty, 0),
    ):
        pixels = evaluate(camera, "color_image", X_WB).reshape(-1, 4)
        np.testing.assert_allclose(pixels, [color] * 32 * 24, atol=tolerance)
        assert np.all(evaluate(camera, "label_image", X_WB) == int(label))
    assert np.all(np.isinf(evaluate(camera, "depth_image_32f", back)))


def test_renders_once_per_pose_and_only_when_asked():
    scene = wall(3)
    camera = SplatCamera(scene, INFO, X_BC)
    context = at_pose(camera, RigidTransform())
    assert scene.colors == scene.depths == 0
    for time in (0.0, 1.0):
        context.SetTime(time)
        for port in ("color_image", "depth_image_32f", "depth_image_16u", "label_image"):
            camera.GetOutputPort(port).Eval(context)
        assert camera.GetOutputPort("image_time").Eval(context)[0] == time
    assert (scene.colors, scene.depths) == (1, 1)
    X_WB = RigidTransform([1.0, 0, 0])
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    for port in ("depth_image_32f", "depth_image_16u"):
        camera.GetOutputPort(port).Eval(context)
    nearer = camera.GetOutputPort("depth_image_32f").Eval(context).data.copy()
    assert camera.GetOutputPort("body_pose_in_world").Eval(context).IsExactlyEqualTo(X_WB)
    assert (scene.colors, scene.depths) == (1, 2)
    np.testing.assert_allclose(nearer, 1.9, rtol=2e-3)
    other = at_pose(camera, X_WB)
    camera.GetOutputPort("color_image").Eval(other)
    np.testing.assert_array_equal(camera.GetOutputPort("depth_image_32f").Eval(other).data, nearer)
    assert (scene.colors, scene.depths) == (2, 3)


WIDTH, HEIGHT, FOCAL = 64, 48, 40.0
SHUTTER_INFO = CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


def pole(x: float = 0.0):
    y = np.arange(-6.0, 6.0, 0.02)
    means = np.column_stack([np.full(y.size, x), y, np.full(y.size, 4.0)])
    return baked_scenes.uniform_scene(means, [0.08] * 3, color=(1.0, 1.0, 1.0))


def columns(color: np.ndarray) -> np.ndarray:
    weights = color.mean(axis=2)
    return (weights * (np.arange(WIDTH) + 0.5)).sum(axis=1) / weights.sum(axis=1)


def yawed(angle: float) -> RigidTransform:
    return RigidTransform(RotationMatrix.MakeYRotation(angle))


@pytest.mark.parametrize("readout", [0.0, 0.01])
def test_motion_blur_is_the_mean_light_of_the_exposure(readout):
    exposure, end = 0.02, (0.02 + readout) / 0.02
    camera = SplatCamera(pole(), SHUTTER_INFO, exposure=exposure, readout=readout)
    sharp = SplatCamera(pole(), SHUTTER_INFO, readout=readout)
    X_0, X_1 = yawed(-0.15), RigidTransform(yawed(0.15 * (2 * end - 1)).rotation(), [0.1, 0.2, 0.0])
    view = camera.render(X_1, None, X_0)
    instants = []
    for s in (np.arange(100) + 0.5) / 100:
        start = pose_between(X_0, X_1, s / end) if readout else None
        instants.append(sharp.render(pose_between(X_0, X_1, (s + end - 1) / end), None, start))
    light, *lights = (light_of_color(255.0 * each.color) for each in (view, *instants))
    expected = np.mean(lights, axis=0)
    assert np.abs(lights[50] - expected).max() > 0.5  # A sharp image is another.
    assert np.abs(light - expected).max() < 0.05
    np.testing.assert_allclose(light.sum(axis=1), expected.sum(axis=1), rtol=0.02)
    assert np.mean(np.abs(view.depth - instants[49].depth) > 0.05) < 0.01


def test_a_still_camera_renders_once():
    scene = wall(3)
    camera = SplatCamera(scene, INFO, X_BC, exposure=0.02)
    still = camera.render(RigidTransform(), None, RigidTransform())
    assert scene.colors == 0  # rendered with depth, at once
    np.testing.assert_array_equal(still.color, camera.render(RigidTransform()).color)


def test_bands():
    X = RigidTransform()
    assert row_bands(X, X, FOCAL, HEIGHT) == [(0, HEIGHT)]
    bands = row_bands(X, RigidTransform([0.1, 0, 0]), FOCAL, HEIGHT)
    assert len(bands) == 8  # 0.1 m at 1 m are 4 px
    assert [row for band in bands for row in range(*band)] == list(range(HEIGHT))
    assert len(row_bands(X, yawed(1.0), FOCAL, HEIGHT)) == HEIGHT


def test_a_rolling_shutter_changes_nothing_for_a_still_camera():
    scene, X = BakedScene(baked_scenes.random_scene()), RigidTransform([0.0, 0.0, -3.0])
    whole = SplatCamera(scene, SHUTTER_INFO).render(X)
    rows = SplatCamera(scene, SHUTTER_INFO, readout=0.02).render(X, Bodies(1.0), X)
    assert (whole.depth > 0).mean() > 0.2
    for one, other in zip(rows, whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize("distortion", [None, Distortion("fisheye", [-0.02, 0.01, 0, 0])])
def test_a_rolling_shutter_needs_the_pose_at_its_start(distortion):
    sky = EnvironmentMap(np.tile([[0.2, 0.4, 0.9]], (8, 16, 1)).astype(np.float32))
    options = {"readout": 0.02, "distortion": distortion, "background": sky, "max_depth": 30.0}
    camera = SplatCamera(pole(), SHUTTER_INFO, **options)

    def images(*ports, start=-0.1):
        context = at_pose(camera, yawed(0.1))
        camera.GetInputPort("start_pose").FixValue(context, yawed(start))
        return [camera.GetOutputPort(name).Eval(context).data.copy() for name in ports]

    color, depth = images("color_image", "depth_image_32f")
    np.testing.assert_array_equal(images("depth_image_32f")[0], depth)
    assert np.any(images("depth_image_32f", start=0.1)[0] != depth)
    where = np.isfinite(depth[..., 0])
    assert where.any(axis=1).all()
    assert color[..., :3][where].min() > 100 and (color[0, 0, :3] == [51, 102, 230]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_depth": 2.0, "max_depth": 1.0}, r"depth range must be .* got \[2.0, 1.0\]"),
        ({"exposure": -0.01}, r"exposure must be finite and >= 0 s, got -0\.01"),
        ({"readout": -0.01}, r"readout must be finite and >= 0 s, got -0\.01"),
        ({"scene": "hall"}, r"scene must be of type BakedScene, got a str; pass `baked`"),
        ({"X_BC": np.eye(4)}, "X_BC must be of type RigidTransform, got a ndarray"),
        ({"camera_info": (64, 48)}, "camera_info must be of type CameraInfo, got a tuple"),
    ],
)
def test_invalid_arguments_are_named_at_construction(change, message):
    with pytest.raises(ValueError, match=message):
        SplatCamera(**{"scene": pole(), "camera_info": INFO} | change)


def test_a_moving_body_is_seen_at_the_time_of_each_row():
    path = [[0.002 * row, 0.0, 0.0] for row in range(1000)]
    obstacles = baked_scenes.moving(pole(), path, 0.001)
    camera = SplatCamera(BakedScene(pole(50.0)), SHUTTER_INFO, readout=0.2)
    view = camera.render(RigidTransform(), Bodies(0.5, obstacles), RigidTransform())
    times = np.interp(np.arange(HEIGHT) + 0.5, [0, HEIGHT], [0.3, 0.5])
    expected = WIDTH / 2 + FOCAL * 2.0 * times / 4.0
    assert np.abs(columns(view.color) - expected).max() < 0.4


def test_mount_and_intrinsics_are_parameters_of_the_context():
    camera = SplatCamera(wall(5.0), INFO, X_BC)
    context = at_pose(camera, RigidTransform())
    port = camera.GetOutputPort("depth_image_32f")
    assert port.Eval(context).data[12, 16, 0] == pytest.approx(4.9, abs=1e-3)
    X = RigidTransform(X_BC.rotation(), [1.5, 0.0, 0.0])
    camera.SetX_BC(context, X)
    assert port.Eval(context).data[12, 16, 0] == pytest.approx(3.5, abs=1e-3)
    assert camera.X_BC(context).IsExactlyEqualTo(X) and camera.X_BC().IsExactlyEqualTo(X_BC)

    X = RigidTransform(RotationMatrix.MakeZRotation(0.5)) @ X
    camera.SetX_BC(context, X)
    before = port.Eval(context).data.copy()
    info = CameraInfo(32, 24, 40.0, 40.0, 16.0, 12.0)
    camera.SetCameraInfo(context, info)
    assert camera.camera_info(context).focal_x() == 40.0
    assert np.abs(port.Eval(context).data - before).max() > 0.1
    expected = evaluate(SplatCamera(wall(5.0), info, X), "depth_image_32f", RigidTransform())
    np.testing.assert_array_equal(port.Eval(context).data, expected)
    other = SplatCamera(wall(5.0), INFO, X_BC).CreateDefaultContext()
    for change, value in ((camera.SetX_BC, X), (camera.SetCameraInfo, info)):
        with pytest.raises(RuntimeError, match="Context"):
            change(other, value)
    with pytest.raises(ValueError, match="image size must be 32x24 pixels, got 16x24"):
        camera.SetCameraInfo(context, CameraInfo(16, 24, 1.0))


@pytest.mark.parametrize(
    ("latency", "time", "taken"),
    [(0.0, 2.0, 2.0), (0.2, 2.0, 1.8), (0.2, 0.1, 0.0), (lambda t: t % 0.5, 2.3, 2.0)],
)
def test_image_time_is_that_of_the_capture(latency, time, taken):
    camera = SplatCamera(wall(5.0), INFO, latency=latency)
    context = camera.CreateDefaultContext()
    context.SetTime(time)
    assert camera.image_time_output_port().Eval(context)[0] == pytest.approx(taken)


def test_late_images_show_bodies_where_they_were():
    obstacles = baked_scenes.moving(pole(-2.0), [[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])
    late, prompt = (SplatCamera(wall(5.0), SHUTTER_INFO, latency=t) for t in (1.0, 0.0))
    for time, then in ((0.5, 0.0), (1.5, 0.5), (2.5, 1.5)):
        expected = prompt.render(RigidTransform(), Bodies(then, obstacles)).color
        image = late.render(RigidTransform(), Bodies(time, obstacles)).color
        np.testing.assert_array_equal(image, expected)
    assert np.any(prompt.render(RigidTransform(), Bodies(time, obstacles)).color != image)


def test_each_row_is_that_of_its_pose():
    camera = SplatCamera(pole(), SHUTTER_INFO, readout=0.02)
    X_0 = RigidTransform(RotationMatrix.MakeXRotation(0.3), [0.1, 0.0, -0.2])
    X_1 = RigidTransform(RotationMatrix.MakeYRotation(0.6), [0.3, 0.1, 0.4])
    assert len(row_bands(X_0, X_1, FOCAL, HEIGHT)) == HEIGHT
    view = camera.render(X_1, None, X_0)
    for row in range(0, HEIGHT, 7):
        own = camera.render(pose_between(X_0, X_1, (row + 0.5) / HEIGHT))
        np.testing.assert_allclose(view.color[row], own.color[row], atol=2e-2)
        seen = own.depth[row] > 0
        assert seen.any() and (view.depth[row] > 0)[seen].mean() > 0.9
        both = seen & (view.depth[row] > 0)
        np.testing.assert_allclose(view.depth[row][both], own.depth[row][both], rtol=5e-3)
