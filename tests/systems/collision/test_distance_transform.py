import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from splatpilot.systems.collision.distance_transform import (
    distance_to_voxels,
    distances_from_band,
    occupancy_distances,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule, Sphere

SIZE = 64
INDEX = np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 3, indexing="ij"), -1)


def exact(*shapes) -> np.ndarray:
    """The distance of a union of shapes at the voxel centers, in voxels."""
    return AnalyticDistanceField(shapes, np.zeros(3), np.full(3, float(SIZE))).distance(INDEX)


SOLIDS = {
    "sphere": exact(Sphere(np.array([32.3, 31.1, 33.7]), 9.3)),
    "pillar": exact(Capsule(np.array([30.3, 33.2, -20.0]), np.array([34.1, 30.9, 90.0]), 2.7)),
    "box": exact(
        Box(
            RigidTransform(RollPitchYaw(0.5, 0.4, 1.1), np.array([31.2, 32.4, 31.8])),
            [9.0, 14.0, 20.0],
        )
    ),
    "union": exact(
        Sphere(np.array([20.3, 20.1, 30.7]), 6.0), Sphere(np.array([44.0, 40.0, 34.0]), 4.5)
    ),
}


def test_distance_to_voxels_against_a_nearest_neighbor_search():
    random = np.random.default_rng(0)
    voxels = random.random((20, 14, 11)) < 0.01
    index = np.stack(np.meshgrid(*map(np.arange, voxels.shape), indexing="ij"), -1)
    expected, _ = KDTree(index[voxels]).query(index)
    np.testing.assert_allclose(distance_to_voxels(voxels, 0.2), 0.2 * expected, rtol=1e-6)


def test_grids_without_a_surface_have_finite_distances():
    none = np.zeros((3, 4, 12), bool)
    assert distance_to_voxels(none, 0.5).min() == pytest.approx(6.5)
    assert occupancy_distances(none, 0.5).min() > 6.0
    assert occupancy_distances(~none, 0.5).max() < -6.0
    band = np.full(none.shape, np.nan, np.float32)
    assert distances_from_band(none, band, 0.5).min() == pytest.approx(6.5)
    assert distances_from_band(~none, band, 0.5).max() == pytest.approx(-6.5)


def distance_to_cubes(voxels: np.ndarray, p: np.ndarray) -> np.ndarray:
    """From points (n, 3) to the nearest marked voxel, (n,), in voxels; by looking at each."""
    centers = np.argwhere(voxels) + 0.5
    beyond = [np.maximum(np.abs(q - centers) - 0.5, 0.0) for q in p]
    return np.array([np.sqrt((each**2).sum(axis=1).min()) for each in beyond])


@pytest.mark.parametrize("share", [0.003, 0.05, 0.3, 0.6, "blobs"])
def test_occupancy_is_never_farther_than_its_voxels(share):
    rng = np.random.default_rng(0)
    noise = rng.random((70, 24, 18))
    occupied = noise < share if share != "blobs" else gaussian_filter(noise, 2.0) > 0.52
    field = Esdf(occupancy_distances(occupied, 1.0), occupied.astype(np.uint8), np.zeros(3), 1.0)
    p = rng.uniform(0.5, np.array(occupied.shape) - 0.5, (3000, 3))
    outside = distance_to_cubes(occupied, p)
    error = field.distance(p) - outside
    assert error[outside > 0.0].max() < 1e-3
    assert -0.5 < error[outside > 0.0].mean() < 0.0
    assert field.distance(p[outside == 0.0]).max(initial=0.0) <= 0.0
    np.testing.assert_array_equal(field.distances < 0.0, occupied)


def test_occupancy_is_exact_beside_walls():
    wall = np.zeros((40, 8, 8), bool)
    wall[10:15] = True
    x = np.arange(40) + 0.5
    expected = np.maximum(10.0 - x, x - 15.0)
    found = occupancy_distances(wall, 0.2)
    np.testing.assert_allclose(
        found, 0.2 * expected[:, None, None] + np.zeros((1, 8, 8)), atol=1e-6
    )


@pytest.mark.parametrize("solid", SOLIDS)
def test_the_surface_within_the_voxels_makes_the_field_accurate(solid):
    phi = SOLIDS[solid].astype(np.float32)
    band = np.where(np.abs(phi) < 1.0, phi, np.float32(np.nan))
    distances = distances_from_band(phi < 0.0, band, 1.0)
    error = distances - phi
    for part in (phi > 0.0, phi < 0.0):
        assert np.sqrt(np.mean(error[part] ** 2)) < 0.2
        assert abs(error[part].mean()) < 0.15
    near = np.abs(phi) < 2.0
    assert np.sqrt(np.mean(error[near] ** 2)) < 0.15
    assert abs(error[near & (phi > 0.0)].mean()) < 0.1
    # A voxel of the band keeps its own value.
    assert np.abs(error[np.isfinite(band)]).max() < 1e-4
    np.testing.assert_array_equal(distances < 0.0, phi < 0.0)
