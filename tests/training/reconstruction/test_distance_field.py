"""The distance field of a reconstruction."""

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.distance_field import (
    DepthSource,
    FieldGrid,
    add_sky,
    choose_grid,
    fuse,
    render_depth,
)
from splatpilot.training.reconstruction.views import ShrunkFrames

K = np.array([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])


def test_space_before_the_sky_is_free_only_where_a_fitted_frame_measured_it():
    measured = np.full((60, 80), np.inf, dtype=np.float32)
    measured[:, 40:] = 0.0
    capture = Capture(
        name="sky",
        source="a test",
        K=K,
        width=80,
        height=60,
        X_WCs=[RigidTransform()] * 2,
        load_image=lambda i: np.zeros((60, 80, 3), np.uint8),
        load_depth=lambda i: measured,
    )
    rendered = np.zeros((30, 40), dtype=np.float32)
    rendered[:15] = 2.0
    half = np.diag([0.5, 0.5, 1.0]) @ K
    source = DepthSource(lambda i: rendered, half, capture.X_WCs)
    sky = add_sky(source, ShrunkFrames(capture, [1], 2))
    np.testing.assert_array_equal(sky.load(0), rendered)
    expected = rendered.copy()
    expected[15:, :20] = np.inf
    np.testing.assert_array_equal(sky.load(1), expected)
    grid = FieldGrid(np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 2.5]), 0.1, 8.0)
    states = fuse(sky, grid).query([[-0.4, 0.4, 1.5], [0.4, 0.4, 1.5]]).state
    np.testing.assert_array_equal(states, [FieldState.FREE, FieldState.UNKNOWN])


def test_masked_pixels_leave_space_unknown():
    valid = np.ones((60, 80), bool)
    valid[:, 40:] = False
    capture = Capture(
        name="half",
        source="a test",
        K=K,
        width=80,
        height=60,
        X_WCs=[RigidTransform()],
        load_image=lambda i: np.zeros((60, 80, 3), np.uint8),
        load_depth=lambda i: np.full((60, 80), 2.0, np.float32),
        load_valid=lambda i: valid,
    )
    measured = DepthSource(capture.registered_depth, K, capture.X_WCs)
    points = np.stack(np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-3, 3, 61)), axis=-1)
    wall = GaussianScene.from_colors(
        np.dstack([points, np.full((61, 61), 2.0)]).reshape(-1, 3),
        np.tile([1.0, 0, 0, 0], (61**2, 1)),
        np.tile([0.1, 0.1, 1e-3], (61**2, 1)),
        np.full(61**2, 0.99),
        np.zeros((61**2, 3)),
    )
    rendered = render_depth(capture, 2, wall, "3dgs", 1)
    grid = FieldGrid(np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 2.5]), 0.1, 8.0)
    for source in (measured, rendered):
        states = fuse(source, grid).query([[-0.4, 0.4, 1.5], [0.4, 0.4, 1.5]]).state
        np.testing.assert_array_equal(states, [FieldState.FREE, FieldState.UNKNOWN])


def _wall(depth: float) -> DepthSource:
    """Half of each image shows a wall, half the sky."""
    image = np.full((60, 80), depth, dtype=np.float32)
    image[:30] = np.inf
    return DepthSource(lambda i: image, K, [RigidTransform()] * 3)


def test_rooms_have_the_grid_of_rooms():
    grid = choose_grid(_wall(3.0), True, ReconstructConfig())
    assert (grid.voxel_size, grid.max_range) == (0.05, 8.0)


def test_large_places_are_seen_as_a_whole_in_few_voxels():
    grid = choose_grid(_wall(40.0), True, ReconstructConfig())
    assert grid.max_range == 60.0
    assert grid.upper_W[2] >= 40.0
    voxels = np.prod((grid.upper_W - grid.lower_W) / grid.voxel_size)
    assert grid.voxel_size > 0.05 and abs(voxels - 20e6) < 0.01 * 20e6


def test_what_is_given_is_taken():
    config = ReconstructConfig(voxel_size=0.1, max_range=8.0)
    grid = choose_grid(_wall(40.0), True, config)
    assert (grid.voxel_size, grid.max_range) == (0.1, 8.0)
    assert grid.upper_W[2] < 9.0


def test_the_grid_of_a_place_without_scale_does_not_change_with_its_unit():
    small, large = (choose_grid(_wall(depth), False, ReconstructConfig()) for depth in (3.0, 300.0))
    np.testing.assert_allclose(large.max_range, 100 * small.max_range)
    np.testing.assert_allclose(small.max_range, 8.0 * 3.0 / 2.0)
    np.testing.assert_allclose(small.voxel_size, 0.05 * 3.0 / 2.0)
    np.testing.assert_allclose(large.voxel_size, 100 * small.voxel_size)
