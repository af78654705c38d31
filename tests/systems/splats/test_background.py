import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.background import (
    EnvironmentMap,
    RenderedView,
    mean_color,
    put_behind,
)
from splatpilot.systems.splats.lens import pixel_slopes

K = np.array([[20.0, 0, 16], [0, 20.0, 12], [0, 0, 1]])


def gradient(height: int = 64, width: int = 128) -> EnvironmentMap:
    """Red is the height of the direction, green and blue how far it looks along x and y."""
    polar = (np.arange(height) + 0.5)[:, None] * np.pi / height
    azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width - np.pi
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    v_W = np.stack([np.cos(polar) + 0 * x, x, y], axis=-1)
    return EnvironmentMap((0.5 + 0.4 * v_W).astype(np.float32))


def test_each_direction_has_its_color():
    axes = [[1, 0, 0], [0, 1, 0], [-1, 1e-9, 0], [-1, -1e-9, 0], [0, -1, 0], [0, 0, 1.0]]
    expected = 0.5 + 0.4 * np.array(axes)[:, [2, 0, 1]]
    np.testing.assert_allclose(gradient().color(axes), expected, atol=0.011)
    np.testing.assert_array_equal(gradient().color(3 * np.array(axes)), gradient().color(axes))


def test_a_camera_sees_what_lies_behind():
    X_WC = RigidTransform(RotationMatrix.MakeYRotation(0.7) @ RotationMatrix.MakeXRotation(-0.4))
    alpha = np.random.default_rng(0).uniform(size=(24, 32)).astype(np.float32)
    alpha[:4] = 1
    color = 0.3 * alpha[..., None] * np.ones(3, np.float32)
    rows, columns = np.mgrid[:24, :32]
    rays = np.stack([(columns + 0.5 - 16) / 20, (rows + 0.5 - 12) / 20, np.ones((24, 32))])
    v_W = np.einsum("ij,jkl->kli", X_WC.rotation().matrix(), rays / np.linalg.norm(rays, axis=0))
    behind, slopes = 0.5 + 0.4 * v_W[..., [2, 0, 1]], pixel_slopes(None, K, 32, 24)
    seen = put_behind(RenderedView(color, alpha, alpha), gradient(), slopes, X_WC)
    np.testing.assert_allclose(seen.color, color + (1 - alpha[..., None]) * behind, atol=3e-3)
    np.testing.assert_array_equal(seen.color[:4], color[:4])
    plain = put_behind(RenderedView(color, alpha, alpha), (0.1, 0.2, 0.3), slopes, X_WC)
    expected = color + (1 - alpha[..., None]) * [0.1, 0.2, 0.3]
    np.testing.assert_allclose(plain.color, expected, atol=1e-3)


def test_the_mean_counts_directions_alike():
    assert mean_color(gradient()) == pytest.approx((0.5, 0.5, 0.5), abs=1e-3)
    cap = np.zeros((64, 128, 3), np.float32)
    cap[:16] = 1  # within 45 deg of the zenith
    share = (1 - np.cos(np.pi / 4)) / 2
    assert mean_color(EnvironmentMap(cap)) == pytest.approx(3 * (share,), abs=1e-3)
    assert mean_color((0.1, 0.2, 0.3)) == (0.1, 0.2, 0.3)


def test_files(tmp_path):
    gradient().save(tmp_path / "map.png")
    back = EnvironmentMap.load(tmp_path / "map.png")
    np.testing.assert_allclose(back.texels, gradient().texels, atol=0.5 / 255 + 1e-6)
    (tmp_path / "bad.png").write_text("no image")
    with pytest.raises(ValueError, match=r"bad\.png: not a readable image"):
        EnvironmentMap.load(tmp_path / "bad.png")
    with pytest.raises(FileNotFoundError, match=r"No such file: .*none\.png"):
        EnvironmentMap.load(tmp_path / "none.png")
