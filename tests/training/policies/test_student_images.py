"""What the student's images go through, in training and in flight."""

import numpy as np
import pytest
import torch

from splatpilot.systems.policies import student as student_observation
from splatpilot.systems.sensing import noise as observation_noise
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.policies.image_noise import disturb_color, noisy_color
from splatpilot.training.policies.student_images import (
    Appearance,
    clean_images,
    in_a_mirror,
    relit,
    training_images,
)


def some_pixels(observation: str) -> np.ndarray:
    """Four images as a corpus holds them."""
    rng = np.random.default_rng(0)
    if observation == "rgb":
        return rng.integers(0, 256, (4, 6, 8, 3)).astype(np.uint8)
    depth = rng.uniform(0.1, 25.0, (4, 6, 8)).astype(np.float16)
    depth[:, 0, 0], depth[:, 1, 1] = 0.0, np.inf
    return depth


@pytest.mark.parametrize("observation", ["rgb", "depth"])
def test_images_of_training_are_those_of_flight(observation):
    """What is encoded in torch is what is encoded in numpy, -1 to 1, too near and too far too."""
    pixels = some_pixels(observation)
    images = clean_images(pixels).numpy()
    for n, image in enumerate(images):
        if observation == "rgb":
            expected = student_observation.encode_color(pixels[n])
        else:
            expected = student_observation.encode_depth(pixels[n].astype(np.float32))
        np.testing.assert_allclose(image, expected, atol=2e-6)
    assert np.abs(images).max() <= 1.0 + 1e-6
    if observation == "depth":
        np.testing.assert_allclose(images[:, 0, 0, 0], 1.0, atol=1e-6)
        np.testing.assert_allclose(images[:, 0, 1, 1], -1.0, atol=1e-6)


def test_colour_noise_of_training_is_that_of_flight():
    """The same draws give the same noisy image, up to the rounding of the camera's."""
    noise = ObservationNoise(color_noise=0.1, brightness_jitter=0.5)
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (2, 5, 6, 3)).astype(np.uint8)
    brighter, grain = rng.uniform(-1, 1, 2), rng.normal(size=color.shape).astype(np.float32)
    found = disturb_color(torch.tensor(color), noise, torch.tensor(brighter), torch.tensor(grain))
    for n in range(2):
        expected = observation_noise.disturb_color(color[n], noise, brighter[n], grain[n])
        np.testing.assert_allclose(found[n], expected, atol=0.51)


def test_exposure_of_training_is_that_of_flight():
    """The same draws expose tensors as they expose arrays, each image by its own error."""
    noise = ObservationNoise(exposure_error=2.0, full_well=500.0, read_noise=5.0, hue_jitter=40.0)
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (2, 5, 6, 3)).astype(np.float32)
    error, photons = rng.uniform(-1, 1, 2), rng.normal(size=color.shape).astype(np.float32)
    drawn = torch.tensor(error)[:, None, None, None], torch.tensor(photons)
    found = observation_noise.expose(torch.tensor(color), noise, *drawn)
    for n in range(2):
        expected = observation_noise.expose(color[n], noise, error[n], photons[n])
        np.testing.assert_allclose(found[n], expected, atol=1e-3)
    generators = (torch.Generator().manual_seed(seed) for seed in (0, 0, 1))
    first, same, other = (noisy_color(torch.tensor(color), noise, g) for g in generators)
    assert torch.equal(first, same) and not torch.equal(first, other)
    assert (first != torch.tensor(color)).any()


def test_light_and_hue():
    """A stop more is twice as bright; turning by 120 degrees makes red green, and grey stays grey
    at any angle."""
    color = torch.tensor([[90.0, 0.0, 0.0], [40.0, 40.0, 40.0]]).reshape(1, 1, 2, 3)
    turned = relit(color, torch.tensor([2.0]), torch.tensor([120.0]))
    torch.testing.assert_close(turned[0, 0, 0], torch.tensor([0.0, 180.0, 0.0]), atol=1e-4, rtol=0)
    for hue in (0.0, 33.0, -150.0):
        turned = relit(color, torch.ones(1), torch.tensor([hue]))
        torch.testing.assert_close(turned[0, 0, 1], color[0, 0, 1], atol=1e-4, rtol=0)


@pytest.mark.parametrize("observation", ["rgb", "depth"])
def test_no_image_is_seen_twice_but_by_the_same_seed(observation):
    """Two draws of the same samples differ, the same state of the generator repeats them, and
    without noise and changes of light what is left is the clean image."""
    pixels, noise = some_pixels(observation), ObservationNoise(depth_additive=0.1, color_noise=0.1)
    generator = torch.Generator().manual_seed(3)
    first, second = (training_images(pixels, Appearance(), noise, generator) for _ in range(2))
    generator.manual_seed(3)
    again = training_images(pixels, Appearance(), noise, generator)
    assert not torch.equal(first, second) and torch.equal(first, again)
    still = Appearance(exposure=0.0, hue=0.0)
    bare = training_images(pixels, still, ObservationNoise(), generator)
    torch.testing.assert_close(bare, clean_images(pixels), atol=1e-5, rtol=0)


@pytest.mark.parametrize("observation", ["rgb", "depth"])
def test_a_mirror_exchanges_left_and_right(observation):
    """Every row runs the other way, of colours and of depth; twice is as before."""
    pixels = some_pixels(observation)
    found = in_a_mirror(pixels)
    for column in range(8):
        np.testing.assert_array_equal(found[:, :, column], pixels[:, :, 7 - column])
    np.testing.assert_array_equal(in_a_mirror(found), pixels)
