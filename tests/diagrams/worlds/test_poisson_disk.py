import numpy as np
from scipy.spatial import KDTree

from splatpilot.diagrams.worlds.building_blocks import poisson_disk

LOWER, UPPER = np.array([-3.0, 2.0]), np.array([27.0, 14.0])


def test_no_two_points_are_closer_than_the_spacing():
    for seed in range(5):
        points = poisson_disk(LOWER, UPPER, 1.3, np.random.default_rng(seed))
        distance, _ = KDTree(points).query(points, k=2)
        assert distance[:, 1].min() >= 1.3
        assert (points >= LOWER).all() and (points <= UPPER).all()


def test_the_rectangle_is_filled():
    points = poisson_disk(LOWER, UPPER, 1.3, np.random.default_rng(0))
    places = np.random.default_rng(1).uniform(LOWER, UPPER, (5000, 2))
    distance, _ = KDTree(points).query(places)
    assert distance.max() < 1.5 * 1.3
    assert np.mean(distance < 1.3) > 0.99


def test_the_points_follow_from_the_generator():
    a, b, c = (poisson_disk(LOWER, UPPER, 2.0, np.random.default_rng(s)) for s in (7, 7, 8))
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape or (a != c).any()


def test_a_rectangle_smaller_than_the_spacing_holds_one_point():
    points = poisson_disk((0, 0), (0.5, 0.5), 3.0, np.random.default_rng(0))
    assert points.shape == (1, 2) and (points >= 0).all() and (points <= 0.5).all()
