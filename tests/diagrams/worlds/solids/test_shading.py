import numpy as np
import pytest

from splatpilot.diagrams.worlds.solids.shading import HAZE_RANGE, Daylight, fade


@pytest.fixture
def light() -> Daylight:
    return Daylight.sample(np.random.default_rng(0))


def test_the_sun_is_up_and_its_direction_follows_from_the_seed():
    for seed in range(20):
        a, b = (Daylight.sample(np.random.default_rng(seed)) for _ in range(2))
        np.testing.assert_array_equal(a.direction, b.direction)
        assert np.linalg.norm(a.direction) == pytest.approx(1)
        assert 32 <= np.rad2deg(np.arcsin(a.direction[2])) <= 58


def test_surfaces_facing_the_sun_are_brightest(light):
    to_sun = light.direction[None]
    sunny, shady = (light.irradiance(to_sun, np.array([s])) for s in (1.0, 0.0))
    assert (sunny > shady + 0.1).all()
    np.testing.assert_array_equal(
        light.irradiance(-to_sun, np.ones(1)), light.irradiance(-to_sun, np.zeros(1))
    )


def test_leaves_shine_from_both_sides(light):
    front, back = (
        light.irradiance(n, np.ones(1), leafy=True) - light.irradiance(n, np.zeros(1), leafy=True)
        for n in _horizontal(light)
    )
    assert front.min() > 0.05
    np.testing.assert_allclose(front, back, atol=1e-6)


def _horizontal(light: Daylight) -> list[np.ndarray]:
    """The two horizontal directions toward and away from the sun, (1, 3): sky is alike on both."""
    flat = np.array([[*light.direction[:2], 0.0]])
    return [flat / np.linalg.norm(flat), -flat / np.linalg.norm(flat)]


def test_a_trunk_throws_its_shadow_away_from_the_sun(light):
    trunk, radius, height = np.array([3.0, -1.0]), 0.3, 9.0
    flat = light.direction[:2] / np.linalg.norm(light.direction[:2])
    side = np.array([-flat[1], flat[0]])
    reach = height * np.hypot(*light.direction[:2]) / light.direction[2]
    places = {
        "behind": trunk - 2.0 * flat,
        "in front": trunk + 2.0 * flat,
        "beside": trunk - 2.0 * flat + 0.6 * side,
        "beyond": trunk - (reach + 0.5) * flat,
    }
    p = np.column_stack([list(places.values()), np.zeros(4)])
    lit = light.past_trunks(p, trunk[None], np.array([radius]), height)
    np.testing.assert_allclose(lit, [0, 1, 1, 1], atol=1e-6)


def test_sun_flecks_move_with_the_point_against_the_sun(light):
    p = np.random.default_rng(1).uniform((-20, -20, 0), (20, 20, 1), (500, 3))
    through = light.through_canopy(p, 8.0, seed=3)
    np.testing.assert_allclose(
        light.through_canopy(p + 4 * light.direction, 8.0, seed=3), through, atol=1e-4
    )
    assert 0.1 < through.mean() < 0.7 and through.min() == 0 and through.max() == 1


def test_haze_swallows_the_distance():
    color, haze = np.array([[0.1, 0.2, 0.3]] * 3), np.array([0.8, 0.9, 1.0])
    faded = fade(color, haze, [0, HAZE_RANGE, 1e4])
    np.testing.assert_allclose(faded[0], color[0])
    np.testing.assert_allclose(faded[1], haze + (color[1] - haze) / np.e)
    np.testing.assert_allclose(faded[2], haze)
