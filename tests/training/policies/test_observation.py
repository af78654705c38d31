import numpy as np
import pytest
import torch

from splatpilot.systems.policies.diffaero import DiffAeroTofConfig
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import (
    equivalent_sensor,
    range_of_depth,
    time_of_flight_grid,
)
from splatpilot.training.policies.train_diffaero import proximity_grid


@pytest.mark.parametrize("camera", [DiffAeroTofConfig().camera, OnboardCamera(32, 18, 100.0)])
def test_training_has_the_grid_of_the_sensor(camera):
    sensor = equivalent_sensor(camera)
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
