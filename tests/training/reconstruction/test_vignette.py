import numpy as np
import pytest

from splatpilot.training.reconstruction.photometry import radius_squared, vignette


def test_corners_have_the_radius_one():
    """Extrapolated by half a pixel along the diagonal, the squared distance is 1 in the corners and
    0 in the centre, and in between it is that of the pixel's centre."""
    found = radius_squared(41, 31)
    assert found.shape == (31, 41)
    assert found[15, 20] == 0
    assert found[0, 0] == pytest.approx((20**2 + 15**2) / (20.5**2 + 15.5**2))
    np.testing.assert_allclose(vignette(-0.5, 41, 31), np.exp(-0.5 * found))
