import dataclasses

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import CaptureFrame, shrink, shrink_factor


def frame_of(depth: np.ndarray) -> CaptureFrame:
    height, width = depth.shape
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    image = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
    return CaptureFrame(image, depth.astype(np.float32), RigidTransform(), K)


@pytest.mark.parametrize(
    ("width", "wanted", "factor"), [(640, 320, 2), (640, 0, 1), (100, 320, 1), (2832, 320, 9)]
)
def test_factors_are_whole_and_never_enlarge(width, wanted, factor):
    assert shrink_factor(width, wanted) == factor


@pytest.mark.parametrize("factor", [2, 3])
def test_a_slanted_plane_keeps_its_depth(factor):
    normal = np.array([0.3, -0.2, 1.0])

    def plane(K, width, height):
        v, u = np.mgrid[0:height, 0:width] + 0.5
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
        return 2 / (ray @ normal)

    frame = frame_of(np.ones((25, 32)))
    frame = frame_of(plane(frame.K, 32, 25))
    small = shrink(frame, factor)
    assert small.depth.shape == small.image.shape[:2] == (25 // factor, 32 // factor)
    np.testing.assert_allclose(small.depth, plane(small.K, 32 // factor, 25 // factor), rtol=1e-6)


def test_edges_holes_and_sky():
    inf = np.inf
    depth = np.array(
        [
            [1, 5, 0, 0, inf, inf, 0, 4],
            [1, 5, 0, 3, inf, inf, 4, 4],
            [1, 1, 2, inf, 0, 0, 1, 1.02],
            [5, 5, 2, inf, 0, 0, 1, 1.02],
        ]
    )
    expected = [[1, 0, inf, 4], [1, 2, 0, 2 / (1 + 1 / 1.02)]]
    np.testing.assert_allclose(shrink(frame_of(depth), 2).depth, expected, rtol=1e-6)


def test_pixels_are_valid_that_replace_valid_ones_alone():
    frame = frame_of(np.ones((5, 8)))
    valid = np.ones((5, 8), bool)
    valid[1, 2] = valid[3, 6:] = valid[4] = False
    small = shrink(dataclasses.replace(frame, valid=valid), 2)
    expected = [[True, False, True, True], [True, True, True, False]]
    np.testing.assert_array_equal(small.valid, expected)
    np.testing.assert_array_equal(small.depth > 0, expected)


def test_colours_are_averaged():
    frame = frame_of(np.ones((4, 6)))
    mean = frame.image.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3))
    assert np.abs(shrink(frame, 2).image - mean).max() <= 0.5
