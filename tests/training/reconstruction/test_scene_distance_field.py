"""The distance field of a reconstruction."""

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.training.captures.capture import Capture
from splatpilot.training.reconstruction.scene_distance_field import DepthSource, add_sky, fuse
from splatpilot.training.reconstruction.views import ShrunkFrames

K = np.array([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])


def test_space_before_the_sky_is_free_only_where_a_fitted_frame_measured_it():
    """Where nothing is rendered, measured infinite depth frees the space before it; unknown depth,
    what is rendered and frames that were withheld stay as they are."""
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
    box = np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 2.5])
    states = fuse(sky, 0.1, 8.0, box).query([[-0.4, 0.4, 1.5], [0.4, 0.4, 1.5]]).state
    np.testing.assert_array_equal(states, [FieldState.FREE, FieldState.UNKNOWN])
