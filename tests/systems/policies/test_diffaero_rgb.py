import cv2
import numpy as np
import pytest
from pydrake.common.schema import Transform
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.policies.diffaero_rgb import (
    DiffAeroRgb,
    DiffAeroRgbConfig,
    MonocularDepth,
    MonocularSpec,
    encode_view,
    rays_B,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"width": 64}, "160 pixels wide.* got 64x90"),
        ({"height": 88}, "160 pixels wide.* got 160x88"),
        ({"height": 91}, "160 pixels wide.* got 160x91"),
        ({"fov_x": 80.0}, r"fov_x must be 90 deg, got 80\.0"),
        ({"fov_y": 90.0}, "fov_y must be left out"),
        ({"X_BC": Transform(RigidTransform())}, "X_BC must be that of a camera along body x"),
    ],
)
def test_cameras_without_the_view_are_refused(fields, message):
    camera = OnboardCamera(**{"width": 160, "height": 90} | fields)
    with pytest.raises(ValueError, match=message):
        DiffAeroRgb(DiffAeroRgbConfig(camera=camera))


def test_rays_are_those_of_the_camera():
    camera, rays = OnboardCamera(width=160, height=90), rays_B()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1.0, atol=1e-6)
    x, y, z = np.moveaxis(rays, 2, 0)
    u, v = camera.width / 2 - camera.focal_x * y / x, camera.height / 2 - camera.focal_x * z / x
    np.testing.assert_allclose(u, np.broadcast_to(np.arange(160) + 0.5, u.shape), atol=1e-4)
    np.testing.assert_allclose(v.T, np.broadcast_to(np.arange(90) + 0.5, v.T.shape), atol=1e-4)


@pytest.mark.parametrize("height", [90, 120])
def test_view_is_the_middle_of_the_image_with_rays_that_show_the_horizon(height):
    rng = np.random.default_rng(1)
    color = rng.integers(0, 256, (height, 160, 3)).astype(np.uint8)
    views = []
    for yaw in (0.0, 2.0):
        R_WB = RollPitchYaw(0.2, -0.3, yaw).ToRotationMatrix().matrix()
        views.append(encode_view(color, R_WB))
        np.testing.assert_allclose(views[-1][5], rays_B() @ R_WB[2], atol=1e-5)
    np.testing.assert_allclose(views[0], views[1], atol=1e-5)
    first = (height - 90) // 2
    shown = np.rint((views[0][:3] + 1.0) * 127.5).astype(np.uint8).transpose(1, 2, 0)
    np.testing.assert_array_equal(shown, color[first : first + 90])


def test_outputs_are_equal_for_any_number_of_threads():
    spec, rng = MonocularSpec(4, (1, 2), 6, (1, 4)), np.random.default_rng(0)
    shapes = spec.weight_shapes().items()
    network = MonocularDepth(spec, {k: rng.normal(size=v).astype(np.float32) for k, v in shapes})
    view = rng.uniform(-1.0, 1.0, (6, 90, 160)).astype(np.float32)
    threads, outputs = cv2.getNumThreads(), []
    try:
        for count in (1, 2, 3):
            cv2.setNumThreads(count)
            outputs.append(np.stack(network(view)))
    finally:
        cv2.setNumThreads(threads)
    assert all(np.array_equal(outputs[0], other) for other in outputs[1:])
