"""SplatCamera."""

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

from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera

INFO = CameraInfo(width=32, height=24, fov_y=np.pi / 2)
# Camera z along body x, as on the vehicle.
X_BC = RigidTransform(RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])), [0.1, 0, 0])


class CountingScene(BakedScene):
    """A scene that counts how often it is rendered, and how often its depth alone."""

    renders = depths = 0

    def render(self, *args, **kwargs):
        self.renders += 1
        return super().render(*args, **kwargs)

    def render_depth(self, *args, **kwargs):
        self.depths += 1
        return super().render_depth(*args, **kwargs)


def wall(x: float, opacity: float = 0.99) -> CountingScene:
    """An orange wall in the world's y-z plane at `x` [m], thick with overlapping splats."""
    y, z = (grid.ravel() for grid in np.meshgrid(*[np.arange(-30, 30.1, 0.5)] * 2))
    means = np.column_stack([np.full(y.size, x), y, z])
    count = len(means)
    return CountingScene(
        GaussianScene.from_colors(
            means=means,
            quats=np.tile([1.0, 0, 0, 0], (count, 1)),
            scales=np.tile([1e-3, 0.5, 0.5], (count, 1)),
            opacities=np.full(count, opacity),
            colors=np.tile([1.0, 0.5, 0.0], (count, 1)),
        )
    )


def evaluate(camera: SplatCamera, port: str, X_WB: RigidTransform) -> np.ndarray:
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    return camera.GetOutputPort(port).Eval(context).data[..., 0]


def test_output_ports_are_those_of_rgbd_sensor():
    """A diagram wired for RgbdSensor's output ports can be wired to a SplatCamera instead."""
    core = RenderCameraCore("none", INFO, ClippingRange(0.01, 10), RigidTransform())
    sensor = RgbdSensor(
        SceneGraph.world_frame_id(),
        RigidTransform(),
        ColorRenderCamera(core),
        DepthRenderCamera(core, DepthRange(0.1, 5)),
    )
    camera = SplatCamera(wall(3), INFO)
    for i in range(sensor.num_output_ports()):
        theirs = sensor.get_output_port(i)
        ours = camera.GetOutputPort(theirs.get_name())
        assert ours.get_data_type() == theirs.get_data_type()
        assert type(ours.Allocate()) is type(theirs.Allocate())
    methods = [name for name in dir(sensor) if name.endswith("_output_port") and name[:3] != "get"]
    assert len(methods) == sensor.num_output_ports()
    for name in methods:
        assert getattr(camera, name)().get_name() == getattr(sensor, name)().get_name()
    assert camera.body_pose_input_port().get_name() == "body_pose"


def test_wall_is_seen_at_its_distance_and_in_its_colour():
    """A wall 3 m ahead of the body reads 2.9 m from a camera 0.1 m ahead of the body, in both depth
    formats.
    """
    camera = SplatCamera(wall(3), INFO, X_BC)
    np.testing.assert_allclose(
        evaluate(camera, "depth_image_32f", RigidTransform()), 2.9, rtol=2e-3
    )
    millimetres = evaluate(camera, "depth_image_16u", RigidTransform())
    np.testing.assert_allclose(millimetres, 2900, rtol=2e-3)
    assert np.all(
        evaluate(camera, "label_image", RigidTransform()) == int(RenderLabel.kUnspecified)
    )
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, RigidTransform())
    rgba = camera.GetOutputPort("color_image").Eval(context).data
    np.testing.assert_allclose(rgba.reshape(-1, 4), [[255, 127.5, 0, 255]] * 32 * 24, atol=3)


@pytest.mark.parametrize(
    ("x", "opacity", "metres", "millimetres"),
    [
        (1.0, 0.99, 0.0, 0),  # nearer than the range
        (9.0, 0.99, np.inf, 65535),  # farther than the range
        (3.0, 0.02, np.inf, 65535),  # hardly there
    ],
)
def test_out_of_range_reads_as_in_drake(x, opacity, metres, millimetres):
    """Too near reads 0; too far, and too faint to be a surface, reads infinity or 65535."""
    camera = SplatCamera(wall(x, opacity), INFO, X_BC, min_depth=2.0, max_depth=5.0)
    assert np.all(evaluate(camera, "depth_image_32f", RigidTransform()) == metres)
    assert np.all(evaluate(camera, "depth_image_16u", RigidTransform()) == millimetres)


def test_nothing_in_view_is_background():
    """Looking away from the wall shows the background, infinite depth and the empty label."""
    camera = SplatCamera(wall(3), INFO, X_BC, background=(0.2, 0.4, 0.6))
    X_WB = RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0, 0, 0])
    assert np.all(np.isinf(evaluate(camera, "depth_image_32f", X_WB)))
    assert np.all(evaluate(camera, "label_image", X_WB) == int(RenderLabel.kEmpty))
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    assert camera.GetOutputPort("color_image").Eval(context).data[0, 0].tolist() == [
        51,
        102,
        153,
        255,
    ]


def test_renders_once_per_pose_and_only_when_asked():
    """All images of one pose cost one render, time alone costs none, and no pull costs none; depth
    that is pulled first, or alone, is rendered alone."""
    scene = wall(3)
    camera = SplatCamera(scene, INFO, X_BC)
    context = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(context, RigidTransform())
    assert scene.renders == 0
    for time in (0.0, 1.0):
        context.SetTime(time)
        for port in ("color_image", "depth_image_32f", "depth_image_16u", "label_image"):
            camera.GetOutputPort(port).Eval(context)
        assert camera.GetOutputPort("image_time").Eval(context)[0] == time
    assert (scene.renders, scene.depths) == (1, 0)
    X_WB = RigidTransform([1.0, 0, 0])
    camera.GetInputPort("body_pose").FixValue(context, X_WB)
    for port in ("depth_image_32f", "depth_image_16u"):
        camera.GetOutputPort(port).Eval(context)
    nearer = camera.GetOutputPort("depth_image_32f").Eval(context).data.copy()
    assert camera.GetOutputPort("body_pose_in_world").Eval(context).IsExactlyEqualTo(X_WB)
    assert (scene.renders, scene.depths) == (1, 1)
    np.testing.assert_allclose(nearer, 1.9, rtol=2e-3)
    other = camera.CreateDefaultContext()
    camera.GetInputPort("body_pose").FixValue(other, X_WB)
    camera.GetOutputPort("color_image").Eval(other)
    np.testing.assert_array_equal(camera.GetOutputPort("depth_image_32f").Eval(other).data, nearer)
    assert (scene.renders, scene.depths) == (2, 1)


def test_depth_range_must_not_be_empty():
    """A depth range that holds nothing is refused by name and value."""
    with pytest.raises(ValueError, match=r"depth range is \[2.0, 1.0\]"):
        SplatCamera(wall(3), INFO, min_depth=2.0, max_depth=1.0)


def test_gaussian_scene_is_baked():
    """A camera of Gaussians that are not baked sees what one of baked Gaussians sees."""
    scene = GaussianScene.from_colors(
        means=[[2.0, 0, 0]],
        quats=[[1.0, 0, 0, 0]],
        scales=[[0.1, 0.3, 0.3]],
        opacities=[0.9],
        colors=[[1.0, 0.5, 0.0]],
    )
    images = [
        evaluate(SplatCamera(given, INFO, X_BC), "color_image", RigidTransform())
        for given in (scene, BakedScene(scene))
    ]
    assert images[0].any() and np.array_equal(*images)
