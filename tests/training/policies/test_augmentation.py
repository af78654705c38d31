import cv2
import numpy as np
import pytest
import torch

from splatpilot.systems.sensing.noise import (
    ObservationNoise,
    corrupt_color,
    corrupt_depth,
    expose,
    rotate_hue,
)
from splatpilot.training.policies.augmentation import (
    Appearance,
    blur,
    change_appearance,
    depth_noise,
    noisy_color,
    noisy_depth,
)
from splatpilot.training.policies.train import validate
from splatpilot.training.policies.train_agile_autonomy import AgileAutonomyTraining
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbTraining
from splatpilot.training.policies.train_student import StudentDepthTraining, StudentRgbTraining

NOISE = ObservationNoise(
    exposure_error=2.0, full_well=500.0, read_noise=5.0, hue_jitter=40.0, blur=1.0
)


def test_noise_takes_arrays_and_tensors():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.0, 20.0, (40, 50)).astype(np.float32)
    depth[:, :5], depth[:, 5:10] = np.inf, 0.0
    draws = [*rng.standard_normal((2, 40, 50)), rng.random((40, 50))]
    color = rng.uniform(0, 255, (2, 5, 6, 3)).astype(np.float32)
    errors = rng.uniform(-1, 1, (2, 1, 1, 1)), rng.normal(size=color.shape)
    noise = ObservationNoise(color_noise=0.1, brightness_jitter=0.5, exposure_error=1, full_well=9)
    for function, kind, arrays in (
        (corrupt_depth, depth_noise(), (depth, *draws)),
        (corrupt_depth, ObservationNoise(1.0, 2.0, 0.3), (depth, *draws)),
        (expose, noise, (color, *errors)),
        (corrupt_color, noise, (color, *errors)),
    ):
        image, *others = map(torch.tensor, arrays)
        expected = function(arrays[0], kind, *arrays[1:])
        np.testing.assert_allclose(function(image, kind, *others), expected, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.5])
def test_blur_is_that_of_opencv(sigma):
    color = np.random.default_rng(0).uniform(0, 255, (2, 24, 31, 3)).astype(np.float32)
    for image, expected in zip(blur(torch.tensor(color), sigma), color, strict=True):
        np.testing.assert_allclose(image, cv2.GaussianBlur(expected, (0, 0), sigma), atol=1e-3)


def test_depth_noise_has_its_sizes():
    noise = ObservationNoise(depth_multiplicative=0.03, depth_additive=0.05, depth_dropout=0.1)
    noisy = noisy_depth(torch.full((400, 100), 4.0), noise, torch.Generator().manual_seed(0))
    seen = torch.isfinite(noisy)
    assert float((~seen).float().mean()) == pytest.approx(0.1, abs=0.01)
    assert float(noisy[seen].std()) == pytest.approx(np.hypot(0.12, 0.05), rel=0.02)
    assert float(noisy[seen].mean()) == pytest.approx(4.0, abs=0.003)


def test_appearance_has_its_sizes():
    color = torch.full((500, 1, 1, 3), 20.0)
    generator = torch.Generator().manual_seed(0)
    stops = (change_appearance(color, Appearance(2.0, 0.0), generator)[:, 0, 0, 0] / 20.0).log2()
    assert stops.min() == pytest.approx(-2.0, abs=0.02)
    assert stops.max() == pytest.approx(2.0, abs=0.02)
    assert change_appearance(10.0 * color, Appearance(2.0, 0.0), generator).max() == 255.0
    gray = change_appearance(color, Appearance(0.0, 180.0), generator)
    torch.testing.assert_close(gray, color, atol=1e-4, rtol=0)
    red = torch.tensor([90.0, 0.0, 0.0]).expand(500, 1, 1, 3)
    turned = change_appearance(red, Appearance(0.0, 60.0), generator)
    torch.testing.assert_close(turned.sum(3).clamp(max=90.0), torch.full((500, 1, 1), 90.0))
    assert 40.0 < turned[..., 1].max() <= 60.001
    third = torch.tensor(2.0 * np.pi / 3.0)
    green = rotate_hue(red, third.cos(), third.sin())
    torch.testing.assert_close(green, red.roll(1, dims=3), atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "change",
    [
        lambda x, g: noisy_color(x, NOISE, g),
        lambda x, g: noisy_depth(x, depth_noise(), g),
        lambda x, g: change_appearance(x, Appearance(), g),
    ],
)
def test_each_image_changes_independently_and_seeds_repeat_it(change):
    color = torch.full((2, 16, 16, 3), 100.0)
    first, same, other = (change(color, torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert torch.equal(first, same) and not torch.equal(first, other)
    assert not torch.equal(first[0], first[1]) and not torch.equal(first, color)


@pytest.mark.parametrize(
    ("config", "noise", "field"),
    [
        (StudentRgbTraining, ObservationNoise(depth_dropout=0.5), "depth_dropout"),
        (StudentRgbTraining, ObservationNoise(latency=0.1), "latency"),
        (StudentDepthTraining, ObservationNoise(color_noise=0.5), "color_noise"),
        (DiffAeroRgbTraining, ObservationNoise(depth_additive=0.1), "depth_additive"),
        (AgileAutonomyTraining, ObservationNoise(brightness_jitter=0.2), "brightness_jitter"),
    ],
)
def test_noise_without_effect_is_refused(config, noise, field):
    with pytest.raises(ValueError, match=rf"noise\.{field} must be left out, got "):
        validate(config(noise=noise))
