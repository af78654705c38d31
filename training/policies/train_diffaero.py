"""Trains DiffAero: analytic gradients of a loss through the dynamics of flight.

After "DiffAero: A GPU-Accelerated Differentiable Simulation Framework for Efficient Quadrotor
Policy Learning" (2025). Different here: the convolutional and recurrent variant; depth to 12 m as
3 / z - 0.6 instead of 1 - range / 5 m; the nearest surface in each pixel; 15 Hz; accelerations
without gravity; 64 environments; desired velocities down the time of arrival instead of straight to
the goal; clearance terms after "Back to Newton's Laws: Learning Vision-based Agile Flight via
Differentiable Physics" (2024) with a gradient through the speed of approach; a vehicle that
collides flies on until the update ends.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from splatpilot.systems.policies import diffaero
from splatpilot.systems.policies.base import (
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
    pool_depth,
)
from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.sensing.time_of_flight import (
    UNMEASURED_DEPTH,
    equivalent_sensor,
    range_of_depth,
)
from splatpilot.training.policies.augmentation import depth_noise
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.rollouts import RolloutConfig, RolloutTraining, Transitions
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.vehicles import Observation


@dataclass
class DiffAeroLoss:
    """Weights of the terms of the loss."""

    # [s/m] Smooth L1 of the mean velocity's error.
    velocity: float = 3.0
    # [s/m^3] Velocity toward an obstacle times max(0, 1 m - d)², d its distance; four nearest.
    clearance: float = 2.0
    # [s/m] Velocity toward an obstacle times softplus(-32 d / m) / 4.
    contact: float = 10.0
    # [s^4/m^2] Square of the acceleration.
    acceleration: float = 0.01
    # [s^6/m^2] Square of the jerk.
    jerk: float = 0.001
    # [m] Subtracted from d, for errors of tracking.
    margin: float = 0.1


@dataclass
class DiffAeroTraining(RolloutTraining):
    """A training run of DiffAero."""

    schedule: Schedule = field(default_factory=lambda: Schedule(updates=12000, validate_every=500))
    loss: DiffAeroLoss = field(default_factory=DiffAeroLoss)


class DiffAeroLearner:
    """Flies by DiffAero's network, see `splatpilot.training.policies.rollouts.Learner`."""

    rate = diffaero.RATE

    def __init__(self, loss: DiffAeroLoss, device: torch.device | str = "cpu") -> None:
        spec = diffaero.DIFFAERO_NETWORK
        self.rays = PixelRays.of(spec.image_width, spec.image_height, diffaero.FOV_X)
        self.network = TrainableNetwork(spec).to(device)
        self._loss = loss
        limits = diffaero.ACCELERATION_LIMITS
        self._limits = torch.tensor(limits, dtype=torch.float32, device=device)

    def initial_memory(self, count: int) -> Tensor:
        return torch.zeros(count, self.network.spec.hidden_size, device=self._limits.device)

    def encode(self, depth: Tensor) -> Tensor:
        """Encodes depth (N, R) [m] as images (N, 9, 16)."""
        image = inverse_depth(depth, diffaero.MIN_DEPTH, diffaero.MAX_DEPTH)
        return image.reshape(-1, *diffaero.IMAGE_SIZE)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        vehicle, R_WH = seen.vehicle, heading_frame(seen.vehicle.yaw)
        p, v, z = vehicle.p, vehicle.v, vehicle.body_z()
        state = heading_observation(p, v, z, seen.p_WG, seen.speed, R_WH)
        output, memory = self.network(self.encode(seen.depth), state, memory)
        command_H = limit_smoothly(output, self._limits)
        return (R_WH @ command_H[:, :, None])[:, :, 0], None, memory

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        d = transitions.clearance - self._loss.margin
        approach = transitions.approach.clamp(min=0.0)
        clearance = (approach * (1.0 - d).clamp(min=0.0).square()).sum(1)
        contact = (approach * torch.nn.functional.softplus(-32.0 * d) / 4.0).sum(1)
        return transitions.losses(self._loss, clearance=clearance, contact=contact)


@dataclass
class DiffAeroTofTraining(DiffAeroTraining):
    """A training run by the grid of a time-of-flight sensor, with late and lost images."""

    schedule: Schedule = field(default_factory=lambda: Schedule(updates=6000, validate_every=500))
    rollout: RolloutConfig = field(
        default_factory=lambda: RolloutConfig(
            noise=replace(
                depth_noise(),
                latency=0.03,
                frame_rate=[10.0, 30.0],
                jitter=0.03,
                frame_dropout=0.05,
            )
        )
    )


class DiffAeroTofLearner(DiffAeroLearner):
    """Flies by the network of DiffAeroTof, tracking its velocities as `VelocityTracker` does."""

    def __init__(self, loss: DiffAeroLoss, device: torch.device | str = "cpu") -> None:
        super().__init__(loss, device)
        camera = diffaero.DiffAeroTofConfig().camera
        self.rays = PixelRays.of(
            camera.width, camera.height, camera.fov_x, camera.focal_x / camera.focal_y
        )
        self._sensor = sensor = equivalent_sensor(camera)
        to_range = range_of_depth(sensor.height, sensor.width, sensor.fov_x, sensor.fov_y)
        self._range_of_depth = torch.tensor(to_range, dtype=torch.float32, device=device)
        self._limits = torch.tensor(diffaero.VELOCITY_LIMITS, dtype=torch.float32, device=device)

    def encode(self, depth: Tensor) -> Tensor:
        """Encodes depth (N, R) [m] as `TimeOfFlightGrid` does: proximities (N, 9, 16)."""
        sensor, (H, W) = self._sensor, self._range_of_depth.shape
        depth = torch.where(depth > UNMEASURED_DEPTH, depth, sensor.max_range).reshape(-1, H, W)
        nearest = pool_depth(depth * self._range_of_depth, sensor.rows, sensor.columns)
        return (1.0 - nearest.clamp(0.0, sensor.max_range) / sensor.max_range).flip(1)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        v_desired, _, memory = super().decide(seen, memory)
        return tracking_acceleration(seen.vehicle.v, v_desired), None, memory
