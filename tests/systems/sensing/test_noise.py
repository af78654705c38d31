import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.policies.base import pool_depth
from splatpilot.systems.sensing.noise import (
    ColorNoise,
    DepthNoise,
    ObservationNoise,
    expose,
    rotate_hue,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

RATE = 15.0  # [Hz]


def noisy(image: np.ndarray, seed: int = 7, *times: float, **sizes) -> np.ndarray:
    """A depth (H, W) or color image (H, W, 3) with noise; a stack of images at several times."""
    height, width = image.shape[:2]
    camera = OnboardCamera(width=width, height=height, min_depth=1.0, max_depth=9.0)
    is_depth = image.ndim == 2
    system = (DepthNoise if is_depth else ColorNoise)(ObservationNoise(**sizes), camera, RATE, seed)
    given = ImageDepth32F(width, height) if is_depth else ImageRgba8U(width, height)
    given.mutable_data[..., : 1 if is_depth else 3] = image[..., None] if is_depth else image
    context, images = system.CreateDefaultContext(), []
    system.get_input_port().FixValue(context, Value(given))
    for time in times or (0.2,):
        context.SetTime(time)
        images.append(np.array(system.get_output_port().Eval(context).data))
    seen = np.array(images)[..., 0] if is_depth else np.array(images)[..., :3]
    return seen if times else seen[0]


def depth(value: float, size=(200, 200)) -> np.ndarray:
    return np.full(size, value, dtype=np.float32)


def color(*value: int, size=(100, 100)) -> np.ndarray:
    return np.full((*size, 3), value, dtype=np.uint8)


NUMBERS = np.arange(100) / RATE


def test_depth_errors_have_their_sizes():
    errors = noisy(depth(4.0), depth_multiplicative=0.03, depth_additive=0.05) - 4.0
    sigma = np.hypot(0.03 * 4.0, 0.05)
    assert errors.std() == pytest.approx(sigma, rel=0.02)  # The estimate's own error is 0.35 %.
    assert abs(errors.mean()) < 4 * sigma / 200


def test_dropout_has_its_rate():
    dropped = noisy(depth(4.0), depth_dropout=0.2)
    assert np.mean(dropped == np.inf) == pytest.approx(0.2, abs=0.01)
    assert set(np.unique(dropped)) == {4.0, np.inf}
    np.testing.assert_array_equal(pool_depth(dropped, 20, 20), 4.0)


@pytest.mark.parametrize(("near", "value"), [(1.0, 0.0), (9.0, np.inf)])
def test_depth_beyond_the_range_is_that_of_drakes_cameras(near, value):
    seen = noisy(depth(near), depth_additive=0.2)
    assert np.mean(seen == value) == pytest.approx(0.5, abs=0.02)
    measured = seen[np.isfinite(seen) & (seen > 0)]
    assert measured.min() >= 1.0 and measured.max() <= 9.0
    ends = np.array([[0.0, np.inf]], dtype=np.float32)  # Unmeasured.
    np.testing.assert_array_equal(noisy(ends, depth_multiplicative=0.5, depth_additive=0.5), ends)


def test_color_noise_has_its_size_and_is_clipped():
    assert noisy(color(100, 100, 100), color_noise=0.04).std() == pytest.approx(10.2, rel=0.05)
    bright = noisy(color(250, 250, 250), color_noise=1.0)
    assert bright.max() == 255 and bright.min() == 0


def test_brightness_changes_whole_images():
    levels = noisy(color(100, 100, 100, size=(4, 4)), 7, *NUMBERS, brightness_jitter=0.3)
    assert all(len(np.unique(level)) == 1 for level in levels)
    shades = levels[:, 0, 0, 0]
    assert 69 <= shades.min() < 80 and 120 < shades.max() <= 130


def test_hue_rotates_about_gray():
    red = np.array([[120.0, 60.0, 60.0]])
    third = rotate_hue(red, math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3))
    np.testing.assert_allclose(third, [[60, 120, 60]], atol=1e-9)
    images = noisy(color(120, 60, 60, size=(4, 4)), 7, *NUMBERS, hue_jitter=30.0).astype(float)
    r, g, b = images[:, 0, 0].T
    angles = np.degrees(np.arctan2(math.sqrt(3.0) * (g - b), 2.0 * r - g - b))
    assert -31.0 < angles.min() < -27.0 and 27.0 < angles.max() < 31.0
    gray = color(100, 100, 100, size=(4, 4))
    np.testing.assert_array_equal(noisy(gray, hue_jitter=30.0), gray)


def test_blur_is_a_gaussian():
    point = color(0, 0, 0, size=(41, 41))
    point[20, 20] = 255
    at = np.arange(41) - 20.0
    expected = 255 / (2 * math.pi * 1.5**2) * np.exp(-np.add.outer(at**2, at**2) / (2 * 1.5**2))
    np.testing.assert_allclose(noisy(point, blur=1.5)[..., 0], expected, atol=0.7)


def test_exposure_scales_light_within_its_error():
    noise = ObservationNoise(exposure_error=1.0)
    light = (expose(np.full(3, 100.0), noise, 0.5, np.zeros(3)) / 255) ** 2.2
    np.testing.assert_allclose(light, 2**0.5 * (100 / 255) ** 2.2, rtol=1e-9)
    assert (expose(np.full(3, 250.0), noise, 1.0, np.zeros(3)) == 255.0).all()


@pytest.mark.parametrize("electrons", [100.0, 300.0])
def test_shot_and_read_noise_have_their_variances(electrons):
    noise = ObservationNoise(full_well=400.0, read_noise=6.0)
    photons = np.random.default_rng(0).standard_normal((200, 200, 3))
    level = np.full(photons.shape, 255 * (electrons / 400) ** (1 / 2.2))
    counted = 400 * (expose(level, noise, 0.0, photons) / 255) ** 2.2
    assert counted.mean() == pytest.approx(electrons, rel=2e-3)
    assert counted.std() == pytest.approx(np.sqrt(electrons + 36.0), rel=0.01)
    dark = 400 * (expose(np.zeros(photons.shape), noise, 0.0, photons) / 255) ** 2.2
    assert dark[dark > 0].std() == pytest.approx(6.0 * np.sqrt(1 - 2 / np.pi), rel=0.01)


@pytest.mark.parametrize("image", [depth(5.0, (60, 80)), color(90, 90, 90, size=(60, 80))])
def test_noise_follows_from_seed_and_image_number(image):
    sizes = {"depth_additive": 0.1, "color_noise": 0.1}
    times = 3 / RATE, 0.0, 3 / RATE, np.nextafter(3 / RATE, 0), 3.3 / RATE, 4 / RATE
    first, start, again, before, near, following = noisy(image, 7, *times, **sizes)
    for same in (again, before, near):
        np.testing.assert_array_equal(first, same)
    for different in (start, following, noisy(image, 8, 3 / RATE, **sizes)[0]):
        assert np.mean(first != different) > 0.8


def test_no_noise_changes_nothing_and_alpha_is_kept():
    none = ObservationNoise()
    assert not (none.changes_depth or none.changes_color or none.is_late)
    np.testing.assert_array_equal(noisy(depth(4.0)), depth(4.0))
    image = ImageRgba8U(8, 6)
    image.mutable_data[:] = np.arange(192).reshape(6, 8, 4)
    camera = OnboardCamera(width=8, height=6)
    system = ColorNoise(ObservationNoise(color_noise=0.5), camera, RATE, 0)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, Value(image))
    seen = system.get_output_port().Eval(context).data
    np.testing.assert_array_equal(seen[..., 3], image.data[..., 3])
