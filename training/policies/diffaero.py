"""DiffAero: a depth policy that learns by analytic gradients through the dynamics.

After X. Zhang et al., "DiffAero: A GPU-accelerated differentiable simulation framework for
efficient quadrotor policy learning".
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from flysplat.systems.policies.diffaero_policy import (
    ACCELERATION_LIMITS,
    DIFFAERO_NETWORK,
    FARTHEST,
    FOV_X,
    NEAREST,
    RATE,
)
from flysplat.training.policies import observation
from flysplat.training.policies.flights import Vehicle
from flysplat.training.policies.network import TrainableNetwork
from flysplat.training.policies.primitives import PinholeGrid
from flysplat.training.policies.through_dynamics import Moment


@dataclass
class DiffAeroLoss:
    """Weights of the terms."""

    velocity: float = 3.0
    clearance: float = 2.0
    contact: float = 10.0
    acceleration: float = 0.01
    jerk: float = 0.001
    margin: float = 0.1
    """[m], kept beyond the vehicle's radius."""


class DiffAeroLearner:
    """See `flysplat.training.policies.through_dynamics.Learner`."""

    def __init__(self, loss: DiffAeroLoss, device: torch.device | str = "cpu") -> None:
        spec = DIFFAERO_NETWORK
        self.rate = RATE
        self.grid = PinholeGrid.of(
            spec.image_width, spec.image_height, float(torch.deg2rad(torch.tensor(FOV_X))), device
        )
        self.network = TrainableNetwork(spec).to(device)
        self._loss = loss
        self._limits = torch.tensor(ACCELERATION_LIMITS, dtype=torch.float32, device=device)

    def initial_memory(self, count: int) -> Tensor:
        return torch.zeros(count, self.network.spec.hidden_size, device=self._limits.device)

    def decide(
        self,
        depth: Tensor,
        vehicle: Vehicle,
        R_WB: Tensor,
        R_WH: Tensor,
        p_WG: Tensor,
        speed: Tensor,
        memory: Tensor,
    ) -> tuple[Tensor, None, Tensor]:
        spec = self.network.spec
        image = observation.inverse_depth(depth, NEAREST, FARTHEST)
        state = observation.heading_observation(R_WB, R_WH, vehicle.p, vehicle.v, p_WG, speed)
        output, memory = self.network(
            image.reshape(-1, spec.image_height, spec.image_width), state, memory
        )
        a_H = observation.limited_acceleration(output, self._limits)
        return (R_WH @ a_H[:, :, None])[:, :, 0], None, memory

    def losses(self, moment: Moment) -> dict[str, Tensor]:
        weights = self._loss
        d = moment.clearance - weights.margin
        approach = moment.approach.clamp(min=0.0)
        clearance = (approach * (1.0 - d).clamp(min=0.0).square()).sum(1).mean()
        contact = (approach * torch.nn.functional.softplus(-32.0 * d) / 4.0).sum(1).mean()
        velocity = torch.nn.functional.smooth_l1_loss(
            moment.v_mean, moment.v_target, reduction="none"
        )
        return {
            "velocity": weights.velocity * velocity.sum(1).mean(),
            "clearance": weights.clearance * clearance,
            "contact": weights.contact * contact,
            "acceleration": weights.acceleration * moment.a.square().sum(1).mean(),
            "jerk": weights.jerk * moment.jerk.square().sum(1).mean(),
        }
