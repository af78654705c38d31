"""Training DiffAero on the grid of a time-of-flight sensor, with velocities as commands.

As `splatpilot.training.policies.diffaero`, but closer to what was published: ranges to 5 m as
1 - range / 5 m, of 86 x 48.4 degrees; and as such a sensor streams: 64x36 pixels pooled to 16x9, 10
to 30 images a second, some late and some lost. What the network decides is a velocity, as
autopilots take, and the vehicle takes it up as `VelocityTracker` does.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from splatpilot.systems.policies.diffaero_tof import DiffAeroTofConfig
from splatpilot.systems.policies.diffaero_tof_inference import RATE, VELOCITY_LIMITS
from splatpilot.systems.sensing.observation_noise import ObservationNoise
from splatpilot.systems.sensing.time_of_flight import range_of_depth, sensor_of
from splatpilot.training.policies import observation
from splatpilot.training.policies.diffaero import DiffAeroLearner, DiffAeroLoss, DiffAeroTraining
from splatpilot.training.policies.differentiable_rollout import RolloutConfig
from splatpilot.training.policies.observation import Observation
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.trainer import Schedule


def streaming_noise() -> ObservationNoise:
    """How the images of such a sensor are disturbed unless a configuration says otherwise."""
    return ObservationNoise(
        depth_multiplicative=0.03,
        depth_additive=0.02,
        depth_dropout=0.01,
        latency=0.03,
        frame_rate=[10.0, 30.0],
        jitter=0.03,
        frame_dropout=0.05,
    )


@dataclass
class DiffAeroTofTraining(DiffAeroTraining):
    """A training run."""

    schedule: Schedule = field(default_factory=lambda: Schedule(updates=6000, validate_every=500))
    rollout: RolloutConfig = field(default_factory=lambda: RolloutConfig(noise=streaming_noise()))


class DiffAeroTofLearner(DiffAeroLearner):
    """See `splatpilot.training.policies.differentiable_rollout.Learner`."""

    rate = RATE

    def __init__(self, loss: DiffAeroLoss, device: torch.device | str = "cpu") -> None:
        super().__init__(loss, device)
        camera = DiffAeroTofConfig().camera
        self.rays = PixelRays.of(
            camera.width, camera.height, camera.fov_x, camera.focal_x / camera.focal_y
        )
        self._sensor = sensor = sensor_of(camera)
        to_range = range_of_depth(sensor.height, sensor.width, sensor.fov_x, sensor.fov_y)
        self._range_of_depth = torch.tensor(to_range, dtype=torch.float32, device=device)
        self._limits = torch.tensor(VELOCITY_LIMITS, dtype=torch.float32, device=device)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        sensor, R_WH = self._sensor, observation.heading_frame(seen.vehicle.yaw)
        grid = observation.proximity_grid(
            seen.depth, self._range_of_depth, sensor.max_range, sensor.rows, sensor.columns
        )
        state = observation.heading_observation(seen, R_WH)
        output, memory = self.network(grid, state, memory)
        v_H = observation.limit_smoothly(output, self._limits)
        v_wanted = (R_WH @ v_H[:, :, None])[:, :, 0]
        return observation.tracking_acceleration(seen.vehicle.v, v_wanted), None, memory
