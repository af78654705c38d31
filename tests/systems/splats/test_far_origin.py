import numpy as np
import pytest

from splatpilot.systems.splats.scene import choose_origin

NEAR = np.random.default_rng(0).normal(size=(100, 3))


@pytest.mark.parametrize(
    ("scale", "offset", "moves"),
    [
        (1.0, 900.0, False),
        (1.0, 1100.0, True),
        (1000.0, 900.0, False),  # as large as it is far
        (1e-3, 0.9, False),
        (1e-3, 5.0, True),  # in units of kilometers
        (0.0, 900.0, False),
        (0.0, 1100.0, True),
    ],
)
def test_origin_moves_to_what_is_far(scale, offset, moves):
    positions = scale * NEAR + [offset, 0, 0]
    origin = choose_origin(positions)
    assert origin.any() == moves
    if moves:
        assert np.linalg.norm(np.median(positions - origin, axis=0)) <= 1


def test_origin_is_in_whole_meters():
    origin = choose_origin(5 * NEAR + [456789.3, 812345.6, -283.1])
    np.testing.assert_array_equal(origin, np.round(origin))
