"""Gaussians as a page holds them."""

import numpy as np
from baked_scenes import random_scene, uniform_scene
from scipy.spatial.transform import Rotation

from splatpilot.systems.visualization.pages import pack_gaussians


def test_words_hold_centers_shades_and_covariances():
    scene = random_scene(50, sh_degree=0).scaled_by(10)
    words = pack_gaussians(scene)
    np.testing.assert_array_equal(words[:, :3].copy().view(np.float32), scene.means)
    shades = words[:, 3:4].copy().view(np.uint8) / 255
    np.testing.assert_allclose(shades[:, :3], scene.base_colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(shades[:, 3], scene.opacities, atol=0.5 / 255 + 1e-6)
    halves = words[:, 4:7].copy().view(np.float16).astype(float) / 256
    R = Rotation.from_quat(scene.quats, scalar_first=True).as_matrix()
    expected = np.einsum("nij,nj,nkj->nik", R, scene.scales.astype(float) ** 2, R)
    expected = expected[:, *np.triu_indices(3)]
    limit = 2**-11 * np.abs(expected).max(axis=1, keepdims=True) + 1e-9
    assert (np.abs(halves - expected) < limit).all()
    assert (words[:, 7] == 0).all()


def test_covariances_beyond_half_floats_shrink_as_a_whole():
    quat = [np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)]  # -45 degrees about z
    words = pack_gaussians(uniform_scene(np.zeros((1, 3)), [60.0, 30.0, 1.0], quat=quat))
    xx, xy, _, yy, _, zz = words[0, 4:7].copy().view(np.float16).astype(float)
    assert xx == yy == np.finfo(np.float16).max
    # (3600 - 900) / (3600 + 900) is 3/5, with the sign of the turn; 1 / 2250 is left of z.
    np.testing.assert_allclose([xy / xx, zz / xx], [-0.6, 1 / 2250], rtol=2e-3)
