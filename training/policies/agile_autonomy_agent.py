"""How Agile Autonomy's policy flies, many vehicles at once in torch."""

import torch
from torch import Tensor

from splatpilot.systems.policies.agile_autonomy_inference import (
    FARTHEST,
    FOV_X,
    NEAREST,
    PROGRESS,
    RATE,
)
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.training.policies.network import TrajectoryModule
from splatpilot.training.policies.observation import Observation, target_velocity
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.vehicles import BodyRate, reaching_acceleration

LOOKAHEAD = 3
"""The waypoint that is tracked: at 0.4 s, as the controller's lookahead."""


class AgileAutonomyAgent:
    """Flies by the cheapest hypothesis, as `HypothesisSelector` and `FlatnessController` do."""

    rate = RATE

    def __init__(self, network: TrajectoryModule, device: torch.device | str = "cpu") -> None:
        spec = network.spec
        self.network = network
        self.rays = PixelRays.of(spec.image_width, spec.image_height, FOV_X)
        self._device = device

    def initial_memory(self, count: int) -> Tensor:
        return torch.zeros(count, 0, device=self._device)

    def observe(self, seen: Observation) -> tuple[Tensor, Tensor]:
        """Images (N, 24, 32) and states (N, 18)."""
        spec, vehicle, R_WB = self.network.spec, seen.vehicle, seen.vehicle.attitude()
        image = 1.0 / seen.depth.clamp(NEAREST, FARTHEST)
        rates = (
            QuadrotorState.of(vehicle.state).w_WB_B
            if isinstance(vehicle, BodyRate)
            else 0.0 * vehicle.v
        )
        v_target = target_velocity(vehicle.p, seen.p_WG, seen.speed)
        rows = torch.stack([vehicle.v, v_target], 1) @ R_WB
        state = torch.cat([R_WB.flatten(1), rows[:, 0], rates, rows[:, 1]], 1)
        return image.reshape(-1, spec.image_height, spec.image_width), state

    def hypotheses(self, seen: Observation) -> tuple[Tensor, Tensor]:
        """Waypoints (N, 3, 10, 3) [m] in the body frame and costs (N, 3) less the progress made."""
        image, state = self.observe(seen)
        waypoints, costs = self.network(image, state)
        ahead_B = torch.nn.functional.normalize(state[:, -3:], dim=1)
        return waypoints, costs - PROGRESS * (waypoints[:, :, -1] * ahead_B[:, None]).sum(2)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        waypoints, costs = self.hypotheses(seen)
        best = waypoints[torch.arange(len(costs), device=costs.device), costs.argmin(1)]
        p_WR = seen.vehicle.p + (seen.vehicle.attitude() @ best[:, LOOKAHEAD, :, None])[:, :, 0]
        return reaching_acceleration(p_WR, seen.vehicle), None, memory
