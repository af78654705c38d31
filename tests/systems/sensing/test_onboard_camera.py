import numpy as np
import pytest

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


def test_mount_looks_ahead_and_up():
    R_BC = OnboardCamera(pitch=30.0).X_BC().rotation().matrix()
    np.testing.assert_allclose(R_BC[:, 2], [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(R_BC[:, 0], [0, -1, 0], atol=1e-12)
