import numpy as np
import pytest

from splatpilot.training.captures.capture import (
    Lens,
    common_pinhole,
    fisheye_lens,
    opencv_lens,
    pinhole,
)

K = pinhole(46.0, 46.0, 32.0, 24.0)
RAYS = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))


def test_fourth_radial_term_is_of_the_eighth_power():
    lens = opencv_lens(K, 64, 48, [0.02, -0.01, 0, 0, 0.005], k4=0.12)
    r2 = (RAYS**2).sum(axis=1, keepdims=True)
    stretch = 1 + 0.02 * r2 - 0.01 * r2**2 + 0.005 * r2**3 + 0.12 * r2**4
    np.testing.assert_allclose(lens.pixels(RAYS), 46 * stretch * RAYS + [32, 24], atol=1e-9)


def test_fisheye_is_that_of_kannala_and_brandt():
    lens = fisheye_lens(K, 64, 48, [0.1, -0.02, 0.003, 0.001])
    r = np.linalg.norm(RAYS, axis=1, keepdims=True)
    theta = np.arctan(r)
    k = 1 + 0.1 * theta**2 - 0.02 * theta**4 + 0.003 * theta**6 + 0.001 * theta**8
    np.testing.assert_allclose(lens.pixels(RAYS), 46 * theta * k / r * RAYS + [32, 24], atol=1e-9)


def test_scaled_lens_sees_the_same_in_more_pixels():
    lens = Lens(K, 64, 48, radius=20.0, source="a file").scale_to(128, 96)
    np.testing.assert_allclose(lens.K, pinhole(92, 92, 64, 48))
    assert (lens.radius, lens.source) == (40, "a file")


def test_pinhole_sees_no_farther_than_the_radius_of_a_lens():
    lens = Lens(K, 64, 48, radius=20.0)
    camera = common_pinhole([lens])
    corner = (np.array([0, 0]) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    assert np.linalg.norm(lens.pixels(corner[None]) - [32, 24]) == pytest.approx(20, rel=2e-3)


@pytest.mark.parametrize("center", [(64.8, 24.0), (32.0, -1.0)])
def test_principal_point_outside_the_image_is_refused(center):
    with pytest.raises(ValueError, match=r"principal point must be in the image of 64x48 px, got"):
        Lens(pinhole(46, 46, *center), 64, 48)


@pytest.mark.parametrize(("cx", "eccentric"), [(32, False), (47, False), (49, True), (15, True)])
def test_eccentric_lenses_are_told(cx, eccentric):
    assert Lens(pinhole(46, 46, cx, 24), 64, 48).is_eccentric == eccentric
