import numpy as np
import pytest

from splatpilot.diagrams.worlds.solids import textures


def test_hash_is_uniform_and_uncorrelated_between_neighbors():
    cells = np.stack(np.meshgrid(*[np.arange(-30, 30)] * 3, indexing="ij"), axis=-1)
    h = textures.hash_unit(cells, seed=3)
    assert h.min() >= 0 and h.max() < 1
    counts, _ = np.histogram(h, bins=20, range=(0, 1))
    expected = h.size / 20
    assert np.square(counts - expected).sum() / expected < 60  # chi-square, 19 degrees of freedom
    for axis in range(3):
        a, b = np.delete(h, 0, axis), np.delete(h, -1, axis)
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.01


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_value_noise_takes_the_lattice_values_with_zero_slope(dimension):
    cells = np.random.default_rng(1).integers(-50, 50, (200, dimension))
    value = 2 * textures.hash_unit(cells, seed=5) - 1
    np.testing.assert_allclose(textures.value_noise(cells, seed=5), value, atol=1e-6)
    for step in (0.01, -0.01):
        near = textures.value_noise(cells + step, seed=5)
        # The textures.fade starts as 10 t^3 along every axis, times a range of 2.
        assert np.abs(near - value).max() < 20e-6 * dimension + 1e-6


def test_fbm_adds_octaves_twice_as_fine_and_half_as_strong_at_each_point():
    points = np.random.default_rng(0).uniform(-20, 20, (400, 3))
    expected = (textures.value_noise(points, 4) + textures.value_noise(2 * points, 5) / 2) / 1.5
    found = textures.fbm(points, 2, seed=4)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    shaped = textures.fbm(points[::-1].reshape(4, 100, 3), 2, seed=4)
    np.testing.assert_array_equal(shaped.ravel(), found[::-1])
    one = textures.fbm(points, 1, seed=4)
    np.testing.assert_array_equal(one, textures.value_noise(points, seed=4))
    assert np.abs(textures.fbm(points, 5)).max() <= 1


def test_values_are_blended_between_the_ends():
    np.testing.assert_allclose(textures.smoothstep(2, 4, [0, 2, 3, 4, 9]), [0, 0, 0.5, 1, 1])
    np.testing.assert_allclose(textures.smoothstep(4, 2, [0, 2, 3, 4, 9]), [1, 1, 0.5, 0, 0])
    a, b = np.array([0.0, 0.2, 1.0]), np.array([1.0, 0.4, 0.0])
    for blend in (textures.mix(a, b, [0, 0.5, 1]), textures.ramp([a, b], [0, 0.5, 1])):
        np.testing.assert_allclose(blend, [a, (a + b) / 2, b], atol=1e-6)


@pytest.fixture
def light() -> textures.Daylight:
    return textures.Daylight.sample(np.random.default_rng(0))


def test_the_sun_is_up_and_its_direction_follows_from_the_seed():
    for seed in range(20):
        a, b = (textures.Daylight.sample(np.random.default_rng(seed)) for _ in range(2))
        np.testing.assert_array_equal(a.direction, b.direction)
        assert np.linalg.norm(a.direction) == pytest.approx(1)
        assert 32 <= np.rad2deg(np.arcsin(a.direction[2])) <= 58


def test_surfaces_facing_the_sun_are_brightest_and_leaves_shine_from_both_sides(light):
    def sunlight(n_W, leafy: bool):
        lit, shady = (light.irradiance(n_W, np.full(1, s), leafy=leafy) for s in (1.0, 0.0))
        return lit - shady

    to_sun = light.direction[None]
    assert sunlight(to_sun, False).min() > 0.1
    np.testing.assert_array_equal(sunlight(-to_sun, False), 0.0)
    flat = to_sun * [1, 1, 0]  # Level: sky is alike on both sides.
    flat /= np.linalg.norm(flat)
    assert sunlight(flat, True).min() > 0.05
    np.testing.assert_allclose(sunlight(flat, True), sunlight(-flat, True), atol=1e-6)


def test_a_trunk_throws_its_shadow_away_from_the_sun(light):
    trunk, height = np.array([3.0, -1.0]), 9.0
    away = -light.direction[:2] / np.linalg.norm(light.direction[:2])
    side = np.array([away[1], -away[0]])
    reach = height * np.hypot(*light.direction[:2]) / light.direction[2]
    behind = trunk + 2.0 * away
    p = np.zeros((4, 3))
    p[:, :2] = behind, trunk - 2.0 * away, behind + 0.6 * side, trunk + (reach + 0.5) * away
    lit = light.past_trunks(p, trunk[None], np.array([0.3]), height)
    np.testing.assert_allclose(lit, [0, 1, 1, 1], atol=1e-6)


def test_sun_flecks_move_with_the_point_against_the_sun(light):
    p = np.random.default_rng(1).uniform((-20, -20, 0), (20, 20, 1), (500, 3))
    through, moved = (light.through_canopy(q, 8.0, seed=3) for q in (p, p + 4 * light.direction))
    np.testing.assert_allclose(moved, through, atol=1e-4)
    assert 0.1 < through.mean() < 0.7 and through.min() == 0 and through.max() == 1


def test_haze_swallows_the_distance():
    color, haze = np.array([[0.1, 0.2, 0.3]] * 3), np.array([0.8, 0.9, 1.0])
    faded = textures.fade(color, haze, [0, textures.HAZE_RANGE, 1e4])
    np.testing.assert_allclose(faded[0], color[0])
    np.testing.assert_allclose(faded[1], haze + (color[1] - haze) / np.e)
    np.testing.assert_allclose(faded[2], haze)
