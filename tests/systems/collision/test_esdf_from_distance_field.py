"""Distance fields sampled from other distance fields."""

import numpy as np

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace


def test_values_at_the_voxel_centers_are_the_fields_own():
    """At every centre the grid holds the analytic distance and state."""
    pillar = Cylinder(np.array([0.4, 0.3, -1.0]), np.array([0.5, 0.5, 3.0]), 0.2)
    field = AnalyticDistanceField(
        [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.07), pillar],
        np.array([-0.5, 0.0, 0.0]),
        np.array([1.5, 1.1, 0.75]),
    )
    grid = esdf_from_distance_field(field, 0.1)
    assert grid.shape == (20, 11, 8)
    p = np.stack(np.meshgrid(*grid.voxel_centers(), indexing="ij"), -1)
    p[..., 2] = np.minimum(p[..., 2], 0.75)  # the last layer's centres lie on the bounds
    np.testing.assert_allclose(grid.distances, field.distance(p), atol=1e-6)
    np.testing.assert_array_equal(grid.states, field.query(p).state)
    assert (grid.states == FieldState.OCCUPIED).any()


def test_unknown_space_stays_unknown():
    """A grid resampled to other voxels keeps which parts are unknown."""
    states = np.zeros((8, 8, 8), np.uint8)
    states[4:] = FieldState.UNKNOWN
    coarse = Esdf(np.ones((8, 8, 8), np.float32), states, np.zeros(3), 0.2)
    fine = esdf_from_distance_field(coarse, 0.1)
    assert fine.shape == (16, 16, 16)
    assert fine.volume(FieldState.UNKNOWN) == coarse.volume(FieldState.UNKNOWN)
