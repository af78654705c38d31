import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.policies.agile_autonomy import AgileAutonomy, AgileAutonomyConfig
from splatpilot.systems.policies.base import inverse_depth, observation, pool_depth, target_velocity
from splatpilot.systems.policies.depthnav import DepthNav, DepthNavConfig
from splatpilot.systems.policies.diffaero import (
    DiffAero,
    DiffAeroConfig,
    DiffAeroTof,
    DiffAeroTofConfig,
)
from splatpilot.systems.policies.diffaero_rgb import DiffAeroRgb, DiffAeroRgbConfig
from splatpilot.systems.policies.reactive import Reactive, ReactiveConfig
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.policies.student import Student, StudentDepthConfig, StudentRgbConfig
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import hover_state

P_WG = np.array([12.0, 3.0, 2.0])
POLICIES = [
    (AgileAutonomy, AgileAutonomyConfig, "depth_image_32f"),
    (DepthNav, DepthNavConfig, "depth_image_32f"),
    (DiffAero, DiffAeroConfig, "depth_image_32f"),
    (DiffAeroTof, DiffAeroTofConfig, "depth_grid"),
    (DiffAeroRgb, DiffAeroRgbConfig, "color_image"),
    (Student, StudentRgbConfig, "color_image"),
    (Student, StudentDepthConfig, "depth_image_32f"),
    (Reactive, ReactiveConfig, "depth_image_32f"),
    (Straight, StraightConfig, ""),
]


def make_image(name: str, camera: OnboardCamera):
    rng, size = np.random.default_rng(1), (camera.height, camera.width)
    if name == "depth_grid":
        grid = rng.uniform(size=(9, 16))
        return grid.ravel(), grid
    if name == "color_image":
        image = ImageRgba8U(camera.width, camera.height)
        image.mutable_data[...] = rng.integers(0, 256, (*size, 4))
        return Value(image), np.asarray(image.data)[..., :3]
    image = ImageDepth32F(camera.width, camera.height)
    image.mutable_data[..., 0] = rng.uniform(0.5, 25.0, size)
    return Value(image), np.asarray(image.data)[..., 0]


@pytest.mark.parametrize(("make", "configure", "image"), POLICIES)
def test_policy_decides_at_its_rate(make, configure, image):
    config = configure(speed=1.7)
    system = make(config)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    x = hover_state([1.0, 2.0, 1.5], yaw=0.6)
    x[3:6], x[10:13] = [1.0, 0.3, 0.1], [0.1, -0.2, 0.3]
    system.GetInputPort("state").FixValue(context, x)
    system.GetInputPort("goal").FixValue(context, P_WG)
    pixels = np.empty(0)
    if image:
        value, pixels = make_image(image, config.camera)
        system.GetInputPort(image).FixValue(context, value)
    assert system.num_input_ports() == 2 + bool(image)
    initial = context.get_discrete_state()
    groups = [np.array(initial.value(i)) for i in range(initial.num_groups())]
    for time in (0.0, 1.0 / config.rate):
        decided = system.decide(observation(time, x, P_WG, pixels), *groups)
        groups = [np.asarray(group, float) for group in decided]
    simulator.Initialize()
    simulator.AdvanceTo(1.5 / config.rate)
    for i in range(system.num_output_ports()):
        found = system.get_output_port(i).Eval(context)
        np.testing.assert_allclose(found, groups[i], rtol=0, atol=1e-9)
        assert np.abs(found).max() > 1e-3


@pytest.mark.parametrize(("make", "configure"), [row[:2] for row in POLICIES[:3]])
def test_cameras_that_cannot_be_pooled_are_refused(make, configure):
    with pytest.raises(ValueError, match=r"whole multiples of .* got 50x30"):
        make(configure(camera=OnboardCamera(width=50, height=30)))


def test_depth_is_pooled_by_its_minimum_and_inverted():
    depth = np.full((4, 6), 9.0)
    depth[1, 1], depth[3, 5], depth[0, 4] = 2.0, 0.0, np.inf
    np.testing.assert_array_equal(pool_depth(depth, 2, 3), [[2.0, 9.0, 9.0], [9.0, 9.0, 0.0]])
    found = inverse_depth(np.array([0.0, 0.3, 3.0, 12.0, np.inf]), 0.3, 12.0)
    assert found == pytest.approx([9.4, 9.4, 0.4, -0.35, -0.35])


def test_target_velocity_points_to_the_goal_and_falls_near_it():
    p_WG = np.array([3.0, -4.0, 2.0])
    far = target_velocity(np.array([0.0, 0.0, 2.0]), p_WG, 2.0, 0.75)
    np.testing.assert_allclose(far, [1.2, -1.6, 0.0])
    near = target_velocity(p_WG - [0.3, 0.0, 0.0], p_WG, 2.0, 0.75)
    np.testing.assert_allclose(near, [0.4, 0.0, 0.0])
    np.testing.assert_array_equal(target_velocity(p_WG, p_WG, 2.0, 0.75), np.zeros(3))
