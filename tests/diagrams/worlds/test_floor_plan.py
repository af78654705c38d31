import itertools

import numpy as np

from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan

PLOT = FloorPlan.of_size(6.0, 4.0, 3.0)


def test_surfaces_face_the_volume_if_they_face_one_of_its_corners():
    rng = np.random.default_rng(0)
    p, n = rng.uniform(-8, 12, (2000, 3)), rng.normal(size=(2000, 3))
    corners = np.array(list(itertools.product((0.0, 6.0), (-2.0, 2.0), (0.0, 3.0))))
    ahead = np.einsum("nk,nck->nc", n, corners - p[:, None]).max(axis=1) > 0
    np.testing.assert_array_equal(PLOT.is_faced(p, n), ahead)
    assert 0.1 < ahead.mean() < 0.9


def test_the_bounds_of_the_volume_face_it_from_outside_only():
    wall, inwards = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]])
    assert PLOT.is_faced(wall, inwards).all()
    assert not PLOT.is_faced(wall, -inwards).any()


def test_outside_is_the_distance_in_plan():
    p = np.array([[3.0, 0.0, 9.0], [3.0, 5.0, 1.0], [-3.0, -6.0, 1.0]])
    np.testing.assert_allclose(PLOT.outside(p), [0, 3, 5])
