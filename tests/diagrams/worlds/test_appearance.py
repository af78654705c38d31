from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.appearance import (
    draw_appearance,
    recolored,
    recolored_background,
    with_appearance,
)
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene

COUNT = 200


@pytest.fixture
def scene() -> GaussianScene:
    rng = np.random.default_rng(5)
    return GaussianScene(
        means=rng.uniform(-5, 5, (COUNT, 3)),
        quats=rng.normal(size=(COUNT, 4)),
        scales=rng.uniform(0.01, 0.1, (COUNT, 3)),
        opacities=np.full(COUNT, 0.9),
        sh=rng.uniform(-0.8, 0.8, (COUNT, 4, 3)),
    )


def draw(seed: int, strength: float = 1.0):
    return draw_appearance(np.random.default_rng(seed), strength)


def test_no_strength_changes_nothing(scene):
    plain = draw(1, strength=0.0)
    same = recolored(scene, plain)
    np.testing.assert_allclose(same.base_colors, scene.base_colors, atol=1e-5)
    np.testing.assert_allclose(same.sh[:, 1:], scene.sh[:, 1:], atol=1e-5)
    sky = (0.2, 0.5, 0.9)
    np.testing.assert_allclose(recolored_background(sky, plain), sky, atol=1e-5)


def test_geometry_stays_and_colors_change(scene):
    first, again, other = (recolored(scene, draw(seed)) for seed in (1, 1, 2))
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(first, name), getattr(scene, name))
    np.testing.assert_array_equal(first.sh, again.sh)
    assert np.abs(first.base_colors - scene.base_colors).mean() > 0.03
    assert np.abs(first.base_colors - other.base_colors).mean() > 0.03


def test_exposure_is_in_stops(scene):
    dark = replace(draw(0, strength=0.0), exposure=0.1)
    light = replace(dark, exposure=0.2)
    a, b = (recolored(scene, look).base_colors ** 2.2 for look in (dark, light))
    np.testing.assert_allclose(b, 2 * a, atol=1e-5)


def test_hue_turns_colors_and_leaves_grays(scene):
    hue = Rotation.from_rotvec(2 / 3 * np.pi * np.ones(3) / np.sqrt(3)).as_matrix()
    look = replace(draw(0, strength=0.0), mixing=hue.astype(np.float32))
    colors = [[0.8, 0.1, 0.1], [0.4, 0.4, 0.4]]
    two = GaussianScene.from_colors(
        scene.means[:2], scene.quats[:2], scene.scales[:2], scene.opacities[:2], colors
    )
    expected = [[0.1, 0.8, 0.1], [0.4, 0.4, 0.4]]
    np.testing.assert_allclose(recolored(two, look).base_colors, expected, atol=1e-5)


def test_light_from_one_side_falls_off_with_the_cosine():
    angles = np.linspace(0, np.pi / 2, 7)
    quats = np.column_stack([np.cos(angles / 2), np.sin(angles / 2), *np.zeros((2, 7))])
    scales, gray = np.tile([0.1, 0.1, 0.001], (7, 1)), np.full((7, 3), 0.5)
    flat = GaussianScene.from_colors(np.zeros((7, 3)), quats, scales, np.full(7, 0.9), gray)
    look = replace(draw(0, 0.0), light_W=np.float32([0, 0, 1]), relief=1.0)
    linear = recolored(flat, look).base_colors[:, 0] ** 2.2
    np.testing.assert_allclose(linear, 2 * 0.5**2.2 * np.cos(angles), atol=1e-5)


def test_environments_are_recolored_in_every_direction():
    texels = np.random.default_rng(0).uniform(0, 1, (4, 8, 3)).astype(np.float32)
    look = draw(7)
    found = recolored_background(EnvironmentMap(texels), look).texels
    np.testing.assert_allclose(found[2, 3], recolored_background(tuple(texels[2, 3]), look))
    assert np.abs(found - texels).mean() > 0.02


def test_world_in_another_look_is_rendered_as_if_made_so():
    world = make_world(ForestConfig(length=8.0, width=6.0, height=4.0), 1)
    seen = with_appearance(world, draw(3))
    camera = OnboardCamera(width=64, height=48)
    view = camera.camera_info().intrinsic_matrix(), 64, 48, camera.mount()
    image = seen.baked.render(*view)
    for one, same in zip(image, BakedScene(seen.gaussians).render(*view), strict=True):
        np.testing.assert_array_equal(one, same)
    before = world.baked.render(*view)
    np.testing.assert_array_equal(image.depth, before.depth)
    assert np.abs(image.color - before.color).mean() > 0.01
