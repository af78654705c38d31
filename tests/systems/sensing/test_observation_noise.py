"""Noise of images."""

import math

import numpy as np
import pytest

from splatpilot.systems.sensing.noise import (
    ObservationNoise,
    expose,
    image_generator,
    noisy_color,
    noisy_depth,
    turned_hue,
)

DEPTH = np.full((200, 200), 4.0, dtype=np.float32)


def test_depth_errors_have_the_sizes_asked_for():
    """Relative and absolute errors add as variances; the mean stays."""
    noise = ObservationNoise(depth_multiplicative=0.03, depth_additive=0.05)
    errors = noisy_depth(DEPTH, noise, image_generator(0, 0), 0.1, 20.0) - 4.0
    sigma = np.hypot(0.03 * 4.0, 0.05)
    assert errors.std() == pytest.approx(sigma, rel=0.02)  # The estimate's own error is 0.35 %.
    assert abs(errors.mean()) < 4 * sigma / 200


def test_dropout_and_range():
    """Dropped pixels read infinity at the rate asked for; what leaves the range reads 0 or
    infinity; what read 0 or infinity stays so.
    """
    dropped = noisy_depth(DEPTH, ObservationNoise(depth_dropout=0.2), image_generator(1, 0), 0, 20)
    assert np.mean(dropped == np.inf) == pytest.approx(0.2, abs=0.01)
    assert set(np.unique(dropped)) == {4.0, np.inf}
    wide = noisy_depth(DEPTH, ObservationNoise(depth_additive=3.0), image_generator(2, 0), 1.0, 9.0)
    read = wide[np.isfinite(wide) & (wide > 0)]
    assert read.min() >= 1.0
    assert read.max() <= 9.0
    assert np.isinf(wide).any()
    assert (wide == 0).any()
    ends = np.array([[0.0, np.inf]], dtype=np.float32)
    noise = ObservationNoise(depth_multiplicative=0.5, depth_additive=0.5)
    np.testing.assert_array_equal(noisy_depth(ends, noise, image_generator(3, 0), 0.1, 20), ends)


def test_color_noise_and_brightness():
    """Pixel noise has the size asked for; brightness changes a whole image by one factor, within
    its limit; results stay within 0 to 255.
    """
    color = np.full((100, 100, 3), 100, dtype=np.uint8)
    grain = noisy_color(color, ObservationNoise(color_noise=0.04), image_generator(0, 0))
    assert grain.std() == pytest.approx(0.04 * 255, rel=0.05)
    jitter = ObservationNoise(brightness_jitter=0.3)
    levels = [noisy_color(color, jitter, image_generator(0, k)) for k in range(50)]
    assert all(len(np.unique(level)) == 1 for level in levels)
    shades = np.array([level[0, 0, 0] for level in levels])
    assert 69 <= shades.min() < 80
    assert 120 < shades.max() <= 130
    bright = np.full((4, 4, 3), 250, dtype=np.uint8)
    assert (
        noisy_color(bright, ObservationNoise(color_noise=1.0), image_generator(0, 0)).max() == 255
    )


def test_hue_and_blur():
    """Hue turns the whole image's colours by one angle within its limit, and leaves grey and
    brightness; blur spreads a point as a Gaussian of that width, and leaves its light."""
    red = np.full((4, 4, 3), [120, 60, 60], dtype=np.uint8)
    third = turned_hue(red.astype(float), math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3))
    np.testing.assert_allclose(third, np.broadcast_to([60, 120, 60], red.shape), atol=1e-9)
    noise, turns = ObservationNoise(hue_jitter=30.0), []
    for number in range(100):
        seen = noisy_color(red, noise, image_generator(0, number)).astype(float)
        assert (seen == seen[0, 0]).all() and abs(seen[0, 0].mean() - 80.0) < 1.0
        r, g, b = seen[0, 0]
        turns.append(math.degrees(math.atan2(math.sqrt(3.0) * (g - b), 2.0 * r - g - b)))
    assert -31.0 < min(turns) < -27.0 and 27.0 < max(turns) < 31.0
    grey = np.full((4, 4, 3), 100, dtype=np.uint8)
    np.testing.assert_array_equal(noisy_color(grey, noise, image_generator(0, 1)), grey)
    point = np.zeros((41, 41, 3), dtype=np.uint8)
    point[20, 20] = 255
    spread = noisy_color(point, ObservationNoise(blur=1.5), image_generator(0, 0))[..., 0]
    at = np.arange(41) - 20.0
    expected = 255 / (2 * math.pi * 1.5**2) * np.exp(-np.add.outer(at**2, at**2) / (2 * 1.5**2))
    np.testing.assert_allclose(spread, expected, atol=0.7)


def test_exposure():
    """An error of exposure is a factor of light for the whole image; what is brighter than white
    stays white."""
    noise = ObservationNoise(exposure_error=1.0)
    grey, error = np.full((4, 4, 3), 100.0), 0.5
    light = (expose(grey, noise, error, np.zeros(grey.shape)) / 255) ** 2.2
    np.testing.assert_allclose(light, 2**0.5 * (100 / 255) ** 2.2, rtol=1e-9)
    assert (expose(np.full(3, 250.0), noise, 1.0, np.zeros(3)) == 255.0).all()
    factors = []
    for number in range(200):
        seen = noisy_color(grey.astype(np.uint8), noise, image_generator(1, number))
        assert len(np.unique(seen)) == 1
        factors.append((seen[0, 0, 0] / 100) ** 2.2)
    assert 0.5 <= min(factors) < 0.55 and 1.85 < max(factors) < 2.03


def test_photons_and_reading():
    """Of N electrons, sqrt(N + read^2) is the noise: in the dark that of reading alone."""
    noise = ObservationNoise(full_well=400.0, read_noise=6.0)
    photons = np.random.default_rng(0).standard_normal((400, 400, 3))
    for electrons in (100.0, 225.0, 300.0):
        color = np.full(photons.shape, 255 * (electrons / 400) ** (1 / 2.2))
        counted = 400 * (expose(color, noise, 0.0, photons) / 255) ** 2.2
        assert counted.mean() == pytest.approx(electrons, rel=2e-3)
        assert counted.std() == pytest.approx(np.sqrt(electrons + 36.0), rel=0.01)
    dark = 400 * (expose(np.zeros(photons.shape), noise, 0.0, photons) / 255) ** 2.2
    assert dark[dark > 0].std() == pytest.approx(6.0 * np.sqrt(1 - 2 / np.pi), rel=0.01)


def test_noise_is_a_function_of_seed_and_number():
    """The same seed and image number give the same bits; another of either gives others."""
    noise = ObservationNoise(depth_additive=0.1)
    images = [
        noisy_depth(DEPTH, noise, image_generator(*key), 0.1, 20.0)
        for key in ((3, 5), (3, 5), (3, 6), (4, 5))
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert np.any(images[0] != images[2])
    assert np.any(images[0] != images[3])


def test_no_noise_changes_nothing():
    """The default passes images as they are."""
    none = ObservationNoise()
    assert not none.changes_depth
    assert not none.changes_color
    np.testing.assert_array_equal(noisy_depth(DEPTH, none, image_generator(0, 0), 0.1, 20), DEPTH)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("depth_dropout", 1.1),
        ("depth_additive", np.inf),
        ("latency", 1.5),
        ("color_noise", -0.1),
        ("exposure_error", 6.5),
        ("read_noise", 3.0),  # of how many electrons?
    ],
)
def test_bad_noise_is_named(field, value):
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=rf"observation.{field} is {value}"):
        ObservationNoise(**{field: value}).validate()


@pytest.mark.parametrize("rates", [[10.0], [30.0, 10.0], [0.0, 10.0]])
def test_rates_of_frames_are_a_range(rates):
    """Rates are two, positive and in order; jitter and losses are of frames with a rate."""
    with pytest.raises(ValueError, match=r"observation\.frame_rate is \["):
        ObservationNoise(frame_rate=rates).validate()
    with pytest.raises(ValueError, match=r"noise\.jitter is 0\.1, but images without a rate"):
        ObservationNoise(jitter=0.1).validate("noise")
    ObservationNoise(frame_rate=[10.0, 10.0], jitter=0.1, frame_dropout=0.5).validate()
