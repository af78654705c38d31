"""Tests of depth without colour, which has the bits of a whole view's."""

from dataclasses import replace

import numpy as np
import pytest
from baked_scenes import HEIGHT, LEVELS, WIDTH, X_WC, K, random_scene
from pydrake.math import RigidTransform

from splatpilot.systems.splats.baked_scene import BakedScene, PlacedGaussians
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene


@pytest.mark.parametrize("simd", LEVELS)
@pytest.mark.parametrize("lens", [None, Distortion(model="fisheye", radial=[0.05, 0.0, 0.0, 0.0])])
@pytest.mark.parametrize("size", [0.02, 0.3, 1.0, 6.0])
def test_depth_alone_has_the_same_bits(simd, lens, size):
    """For Gaussians of all sizes and tilts, those that fall between the pixels too, among moving
    ones, and through a lens, depth rendered alone is that of the whole view, however far it is
    asked for."""
    bodies = random_scene(count=200, seed=1, sh_degree=0)
    moving = PlacedGaussians(
        *(getattr(bodies, name) for name in ("means", "quats", "scales", "opacities", "sh"))
    )
    scene = random_scene(count=3000)
    scene = BakedScene(replace(scene, scales=np.float32(size) * scene.scales), simd=simd)
    camera = {"K": K, "width": WIDTH, "height": HEIGHT, "moving": moving, "distortion": lens}
    for X in (X_WC, RigidTransform([0.1, 0.2, -0.5])):
        assert (scene.render(X_WC=X, **camera).depth > 0).mean() > 0.1
        for max_depth in (0.2, 1.0, 2.0, 3.0, 5.0, np.inf):
            whole = scene.render(X_WC=X, max_depth=max_depth, **camera).depth
            alone = scene.render_depth(X_WC=X, max_depth=max_depth, **camera)
            np.testing.assert_array_equal(alone, whole)


@pytest.mark.parametrize("simd", LEVELS)
def test_needles_seen_edge_on_have_the_same_depth_alone(simd):
    """Discs without thickness, seen within a thousandth of edge-on, hold few pixels' centres and
    ask much of float32: of depth alone none is missed."""
    rng = np.random.default_rng(4)
    scene = random_scene(count=2000, sh_degree=0)
    towards = scene.means - np.array([0.0, 0.0, -3.0])
    normals = np.cross(towards, rng.normal(size=towards.shape))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals += 1e-3 * rng.normal(size=normals.shape)
    x, y, z = normals.T / np.linalg.norm(normals, axis=1)
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)  # turns the z axis to the normal
    scales = np.tile([0.5, 0.5, 1e-5], (len(quats), 1))
    sheets = replace(scene, quats=quats.astype(np.float32), scales=scales.astype(np.float32))
    baked = BakedScene(replace(sheets, opacities=np.ones_like(scene.opacities)), simd=simd)
    X = RigidTransform([0.0, 0.0, -3.0])
    whole = baked.render(K, WIDTH, HEIGHT, X).depth
    assert (whole > 0).mean() > 0.1
    np.testing.assert_array_equal(baked.render_depth(K, WIDTH, HEIGHT, X), whole)


@pytest.mark.parametrize("simd", LEVELS)
def test_a_disc_seen_exactly_edge_on_has_depth_alone(simd):
    """Without any blur it has no area; the pixels along it show it where its centre is."""
    disc = GaussianScene(
        means=np.array([[0.0, 0.0, 2.0]], np.float32),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        scales=np.array([[1e-30, 0.3, 0.3]], np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    through_centres = np.array([[70.0, 0, 41.5], [0, 75.0, 30.5], [0, 0, 1]])
    camera = (through_centres, WIDTH, HEIGHT, RigidTransform())
    depth = BakedScene(disc, simd=simd).render_depth(*camera)
    assert depth[30, 41] == pytest.approx(2.0)
    np.testing.assert_array_equal(np.unique(np.nonzero(depth)[1]), [41])


@pytest.mark.parametrize("simd", LEVELS)
def test_what_is_too_far_hides_nothing(simd):
    """A wall at 6 m comes before the floor whose centre is at 6.5 m, though here the floor is seen
    at 5.45 m. In an image of up to 5.6 m the floor is alone."""
    half = 0.5**0.5
    scene = GaussianScene(
        means=np.array([[0.0, 0.0, 6.0], [0.0, 2.0, 6.5]], np.float32),
        quats=np.array([[1.0, 0.0, 0.0, 0.0], [half, half, 0.0, 0.0]], np.float32),
        scales=np.array([[4.0, 4.0, 0.001], [1.75, 1.75, 0.001]], np.float32),
        opacities=np.ones(2, np.float32),
        sh=np.zeros((2, 1, 3), np.float32),
    )
    baked = BakedScene(scene, simd=simd)
    floor = 2.0 / ((57.5 - 30.0) / 75.0)  # 2 m below, at the slope of row 57
    for max_depth, expected in ((5.6, floor), (7.0, 6.0)):
        depth = baked.render_depth(K, WIDTH, HEIGHT, RigidTransform(), max_depth=max_depth)
        assert depth[57, 41] == pytest.approx(expected, abs=0.001)
