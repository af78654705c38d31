"""Gaussians as a page holds them."""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.visualization.pages import pack_gaussians


def test_words_hold_centers_shades_and_covariances():
    generator = np.random.default_rng(0)
    n = 50
    scene = GaussianScene.from_colors(
        means=generator.normal(size=(n, 3)) * 100,
        quats=generator.normal(size=(n, 4)),
        scales=10 ** generator.uniform(-3, 1, (n, 3)),
        opacities=generator.uniform(0.01, 1, n),
        colors=generator.uniform(size=(n, 3)),
    )
    words = pack_gaussians(scene)
    np.testing.assert_array_equal(words[:, :3].copy().view(np.float32), scene.means)
    shades = words[:, 3:4].copy().view(np.uint8) / 255
    np.testing.assert_allclose(shades[:, :3], scene.base_colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(shades[:, 3], scene.opacities, atol=0.5 / 255 + 1e-6)
    halves = words[:, 4:7].copy().view(np.float16).astype(float) / 256
    for row, quat, scale in zip(halves, scene.quats, scene.scales, strict=True):
        wxyz = quat.astype(float) / np.linalg.norm(quat.astype(float))
        R = RotationMatrix(Quaternion(wxyz)).matrix()
        covariance = R @ np.diag(scale.astype(float) ** 2) @ R.T
        packed = covariance[np.triu_indices(3)]
        np.testing.assert_allclose(row, packed, atol=2**-11 * np.abs(packed).max() + 1e-9)
    assert (words[:, 7] == 0).all()


def test_covariances_beyond_half_floats_shrink_as_a_whole():
    scene = GaussianScene.from_colors(
        means=np.zeros((1, 3)),
        quats=[[np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)]],  # -45 degrees about z
        scales=[[60.0, 30.0, 1.0]],
        opacities=[0.5],
        colors=[[0.5, 0.5, 0.5]],
    )
    xx, xy, _, yy, _, zz = pack_gaussians(scene)[0, 4:7].copy().view(np.float16).astype(float)
    assert xx == yy == np.finfo(np.float16).max
    # (3600 - 900) / (3600 + 900) is 3/5, with the sign of the turn; 1 / 2250 is left of z.
    np.testing.assert_allclose([xy / xx, zz / xx], [-0.6, 1 / 2250], rtol=2e-3)
