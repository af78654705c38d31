"""What policies in training are told, against what those in flight are."""

import cv2
import numpy as np
import pytest
import torch

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.diffaero import DiffAeroTofConfig
from splatpilot.systems.sensing import noise as observation_noise
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import (
    range_of_depth,
    sensor_of,
    time_of_flight_grid,
)
from splatpilot.training.policies.image_noise import (
    blurred,
    disturb_depth,
    noisy_depth,
    training_noise,
)
from splatpilot.training.policies.student_config import StudentDepthTraining, StudentRgbTraining
from splatpilot.training.policies.train_agile_autonomy import AgileAutonomyTraining
from splatpilot.training.policies.train_diffaero import DiffAeroTraining, proximity_grid
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbTraining


@pytest.mark.parametrize("noise", [training_noise(), ObservationNoise(1.0, 2.0, 0.3)])
def test_training_disturbs_depth_as_flight_does(noise):
    """Of the same draws torch and numpy make the same of every depth: of those that read nothing,
    too near or next to it, and where errors exceed the depth."""
    random = np.random.default_rng(0)
    depth = random.uniform(0.0, 20.0, (40, 50)).astype(np.float32)
    depth[:, :5], depth[:, 5:10] = np.inf, 0.0
    draws = [*random.standard_normal((2, 40, 50)), random.random((40, 50))]
    flown = observation_noise.disturb_depth(depth, noise, *draws, 0.0, np.inf)
    trained = disturb_depth(torch.tensor(depth), noise, *(torch.tensor(d) for d in draws))
    np.testing.assert_allclose(trained, flown, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.5])
def test_training_blurs_as_flight_does(sigma):
    """Torch and OpenCV make the same of colours, up to the edges."""
    color = np.random.default_rng(0).uniform(0, 255, (2, 24, 31, 3)).astype(np.float32)
    trained = blurred(torch.tensor(color), sigma)
    for image, expected in zip(trained, color, strict=True):
        flown = cv2.GaussianBlur(expected, (0, 0), sigma)
        np.testing.assert_allclose(image, flown, atol=1e-3)


def test_noise_is_drawn_as_asked_for():
    """Errors and holes have their sizes, and the same generator gives the same noise."""
    noise = ObservationNoise(depth_multiplicative=0.03, depth_additive=0.05, depth_dropout=0.1)
    depth = torch.full((400, 100), 4.0)
    noisy, again = (noisy_depth(depth, noise, torch.Generator().manual_seed(0)) for _ in "ab")
    torch.testing.assert_close(noisy, again, rtol=0, atol=0)
    seen = torch.isfinite(noisy)
    assert float((~seen).float().mean()) == pytest.approx(0.1, abs=0.01)
    assert float(noisy[seen].std()) == pytest.approx(np.hypot(0.12, 0.05), rel=0.02)
    assert float(noisy[seen].mean()) == pytest.approx(4.0, abs=0.003)


@pytest.mark.parametrize("camera", [DiffAeroTofConfig().camera, OnboardCamera(32, 18, 100.0)])
def test_training_has_the_grid_of_the_sensor(camera):
    """In images of any depth, not measured and infinite too, torch finds the proximities that
    frames of that sensor become."""
    sensor = sensor_of(camera)
    depth = np.random.default_rng(0).uniform(0.0, 9.0, (5, camera.height, camera.width))
    depth[depth < 1.0], depth[depth > 8.0] = 0.0, np.inf
    depth[0] = np.inf
    to_range = range_of_depth(sensor.height, sensor.width, sensor.fov_x, sensor.fov_y)
    trained = proximity_grid(
        torch.tensor(depth).flatten(1), torch.tensor(to_range), sensor.max_range, 9, 16
    )
    flown = np.stack([time_of_flight_grid(image, sensor) for image in depth])
    np.testing.assert_allclose(trained, flown, atol=1e-12)
    assert flown[1:].max() > 0.7 and not flown[0].any()


@pytest.mark.parametrize(
    ("config", "noise", "field"),
    [
        (StudentRgbTraining, ObservationNoise(depth_dropout=0.5), "depth_dropout"),
        (StudentRgbTraining, ObservationNoise(latency=0.1), "latency"),
        (StudentRgbTraining, ObservationNoise(frame_rate=[5.0, 10.0]), "frame_rate"),
        (StudentDepthTraining, ObservationNoise(color_noise=0.5), "color_noise"),
        (StudentDepthTraining, ObservationNoise(blur=3.0), "blur"),
        (DiffAeroRgbTraining, ObservationNoise(depth_additive=0.1), "depth_additive"),
        (AgileAutonomyTraining, ObservationNoise(brightness_jitter=0.2), "brightness_jitter"),
        (AgileAutonomyTraining, ObservationNoise(full_well=8000, read_noise=5), "full_well"),
    ],
)
def test_noise_without_effect_is_refused(config, noise, field):
    with pytest.raises(ValueError, match=rf"noise\.{field} must be left out, got "):
        config(noise=noise).validate()


def test_noise_out_of_range_is_refused():
    config = load_config(DiffAeroTraining(), overrides=["rollout.noise.latency=2"])
    with pytest.raises(ValueError, match=r"rollout\.noise\.latency is 2\.0; it must be"):
        config.validate()


def test_depth_has_no_appearance_to_change():
    with pytest.raises(ValueError, match="appearance must be left out, got "):
        load_config(StudentDepthTraining(), overrides=["appearance.hue=10"]).validate()


def test_noise_that_does_not_exist_is_named():
    """A field that there is not, in a scenario and in training, is an error that lists those that
    there are."""
    for config, field in (Scenario(), "observation"), (DiffAeroTraining(), "rollout.noise"):
        known = rf"there is no field {field}\.fog; the fields are .*{field}\.depth_dropout"
        with pytest.raises(ValueError, match=known):
            load_config(config, overrides=[f"{field}.fog=0.1"])
