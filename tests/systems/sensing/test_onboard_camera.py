import numpy as np
import pytest

from splatpilot.systems.common.config import dump_config, parse_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera


@pytest.mark.parametrize("fov_y", [None, 60.0])
def test_rays_agree_with_drakes_intrinsics(fov_y):
    camera = OnboardCamera(width=6, height=4, fov_x=70.0, fov_y=fov_y)
    pixels = camera.ray_slopes() @ camera.camera_info().intrinsic_matrix().T  # (4, 6, 3)
    columns, rows = np.meshgrid(np.arange(6) + 0.5, np.arange(4) + 0.5)
    np.testing.assert_allclose(pixels[..., 0], columns)
    np.testing.assert_allclose(pixels[..., 1], rows)
    assert np.rad2deg(camera.camera_info().fov_x()) == pytest.approx(70.0)
    square = 2 * np.rad2deg(np.arctan(np.tan(np.deg2rad(35.0)) * 4 / 6))
    assert np.rad2deg(camera.camera_info().fov_y()) == pytest.approx(fov_y or square)


@pytest.mark.parametrize(
    ("up", "left", "direction"),
    [
        (30.0, 0.0, [np.cos(np.pi / 6), 0.0, 0.5]),
        (0.0, 90.0, [0.0, 1.0, 0.0]),
        (-90.0, 0.0, [0.0, 0.0, -1.0]),
    ],
)
def test_a_mount_looks_up_and_left(up, left, direction):
    text = f"X_BC: {{rotation: !Rpy {{deg: [{up - 90}, 0, {left - 90}]}}}}"
    camera = parse_config(OnboardCamera(), text, "text")
    np.testing.assert_allclose(camera.mount().rotation().col(2), direction, atol=1e-12)
    np.testing.assert_array_equal(camera.mount().translation(), [0.1, 0.0, 0.0])
    assert parse_config(OnboardCamera(), dump_config(camera), "text") == camera != OnboardCamera()
    R_BC = OnboardCamera().mount().rotation().matrix()
    np.testing.assert_array_equal(R_BC, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
