import numpy as np
import pytest

from splatpilot.diagrams.worlds.solids.textures import (
    fbm,
    hash_unit,
    mix,
    ramp,
    smoothstep,
    value_noise,
)


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-20, 20, (4000, 3))


def test_hash_is_uniform_and_uncorrelated_between_neighbors():
    cells = np.stack(np.meshgrid(*[np.arange(-30, 30)] * 3, indexing="ij"), axis=-1)
    h = hash_unit(cells, seed=3)
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
    value = 2 * hash_unit(cells, seed=5) - 1
    np.testing.assert_allclose(value_noise(cells, seed=5), value, atol=1e-6)
    for step in (0.01, -0.01):
        near = value_noise(cells + step, seed=5)
        # The fade starts as 10 t^3 along every axis, times a range of 2.
        assert np.abs(near - value).max() < 20e-6 * dimension + 1e-6


def test_noise_of_a_point_does_not_depend_on_other_points(points):
    whole = fbm(points, 4, seed=2)
    order = np.random.default_rng(2).permutation(len(points))
    np.testing.assert_array_equal(fbm(points[order], 4, seed=2), whole[order])
    np.testing.assert_array_equal(fbm(points.reshape(40, 100, 3), 4, seed=2).ravel(), whole)


def test_fbm_adds_octaves_twice_as_fine_and_half_as_strong(points):
    expected = (value_noise(points, 4) + value_noise(2 * points, 5) / 2) / 1.5
    np.testing.assert_allclose(fbm(points, 2, seed=4), expected, atol=1e-6)
    np.testing.assert_array_equal(fbm(points, 1, seed=4), value_noise(points, seed=4))
    assert np.abs(fbm(points, 5)).max() <= 1


def test_smoothstep_rises_and_falls_between_its_ends():
    np.testing.assert_allclose(smoothstep(2, 4, [0, 2, 3, 4, 9]), [0, 0, 0.5, 1, 1])
    np.testing.assert_allclose(smoothstep(4, 2, [0, 2, 3, 4, 9]), [1, 1, 0.5, 0, 0])


def test_mix_and_ramp_are_linear():
    a, b = np.array([0.0, 0.2, 1.0]), np.array([1.0, 0.4, 0.0])
    for blend in (mix(a, b, [0, 0.5, 1]), ramp([a, b], [0, 0.5, 1])):
        np.testing.assert_allclose(blend, [a, (a + b) / 2, b], atol=1e-6)
