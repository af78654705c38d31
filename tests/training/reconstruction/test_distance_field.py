from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, no_depth
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.distance_field import (
    DepthSource,
    FieldGrid,
    add_sky,
    captured_depth,
    choose_grid,
    fuse,
    make_distance_field,
    render_depth,
)
from splatpilot.training.reconstruction.views import ShrunkFrames

K = np.array([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])


GRID = FieldGrid(np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 2.5]), 0.1, 8.0)
ALL = np.ones((60, 80), bool)


def make_capture(depth: np.ndarray, valid: np.ndarray) -> Capture:
    return Capture(
        *("half", "a test", K, 80, 60, [RigidTransform()] * 2),
        load_image=lambda i: np.zeros((60, 80, 3), np.uint8),
        load_depth=lambda i: depth,
        load_valid=lambda i: valid,
    )


def wall(depth: float) -> GaussianScene:
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-3, 3, 61)] * 2))
    one = np.ones((len(x), 1))
    means = np.column_stack([x, y, depth * one])
    quats, scales = one * [1.0, 0, 0, 0], one * [0.1, 0.1, 1e-3]
    return GaussianScene.from_colors(means, quats, scales, 0.99 * one[:, 0], 0 * means)


def assert_right_half_is_unknown(source: DepthSource) -> None:
    states = fuse(source, GRID).query([[-0.4, 0.4, 1.5], [0.4, 0.4, 1.5]]).state
    np.testing.assert_array_equal(states, [FieldState.FREE, FieldState.UNKNOWN])


def test_space_before_the_sky_is_free_only_if_a_fitted_frame_measured_it():
    measured = np.full((60, 80), np.inf, dtype=np.float32)
    measured[:, 40:] = 0.0
    capture = make_capture(measured, ALL)
    rendered = np.zeros((30, 40), dtype=np.float32)
    rendered[:15] = 2.0
    source = DepthSource(lambda i: rendered, np.diag([0.5, 0.5, 1.0]) @ K, capture.X_WCs)
    sky = add_sky(source, ShrunkFrames(capture, [1], 2))
    np.testing.assert_array_equal(sky.load(0), rendered)
    expected = rendered.copy()
    expected[15:, :20] = np.inf
    np.testing.assert_array_equal(sky.load(1), expected)
    assert_right_half_is_unknown(sky)


def test_masked_pixels_leave_space_unknown():
    valid = ALL & (np.arange(80) < 40)
    capture = make_capture(np.full((60, 80), 2.0, np.float32), valid)
    assert_right_half_is_unknown(captured_depth(capture, [0]))
    assert_right_half_is_unknown(render_depth(capture, 2, wall(2.0), "3dgs", 1))


@pytest.mark.parametrize(("aside", "distance"), [(0.4, 2.03), (0.0, 2.03), (0.0, 203.0)])
def test_depth_of_photographs_from_one_position_frees_no_space(aside, distance):
    X_WCs = [RigidTransform(np.array([x, 0.0, 0.0])) for x in (-aside, 0.0, aside)]
    capture = replace(make_capture(ALL, ALL), X_WCs=X_WCs, load_depth=no_depth)
    config = ReconstructConfig(iterations=1, voxel_size=0.1)
    field, _ = make_distance_field(capture, ShrunkFrames(capture, [0], 1), wall(distance), config)
    assert (field.query([[0.0, 0.0, 1.5]]).state == [FieldState.FREE]) == (aside > 0.0)


def _grid(depth: float, metric: bool = True, **config) -> FieldGrid:
    """The grid of images that show half a wall, half the sky."""
    image = np.full((60, 80), depth, dtype=np.float32)
    image[:30] = np.inf
    wall = DepthSource(lambda i: image, K, [RigidTransform()] * 3)
    return choose_grid(wall, metric, ReconstructConfig(**config))


def test_grid_follows_the_config_or_the_size_of_the_scene():
    room, large = _grid(3.0), _grid(40.0)
    assert (room.voxel_size, room.max_range) == (0.05, 8.0)
    assert large.max_range == 60.0 and large.upper_W[2] >= 40.0
    voxels = np.prod((large.upper_W - large.lower_W) / large.voxel_size)
    assert large.voxel_size > 0.05 and abs(voxels - 20e6) < 0.01 * 20e6
    given = _grid(40.0, voxel_size=0.1, max_range=8.0)
    assert (given.voxel_size, given.max_range) == (0.1, 8.0) and given.upper_W[2] < 9.0
    for depth in (3.0, 300.0):  # without scale, relative to the median depth
        unscaled = _grid(depth, metric=False)
        assert unscaled.max_range == pytest.approx(8.0 * depth / 2.0)
        assert unscaled.voxel_size == pytest.approx(0.05 * depth / 2.0)
