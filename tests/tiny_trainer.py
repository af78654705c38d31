"""A trainer that needs no worlds, for tests of how runs go on and end."""

from dataclasses import dataclass, field

import torch

from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.trainer import Schedule


@dataclass
class TinyTraining:
    """Of nine updates, with a checkpoint after every other one."""

    seed: int = 0
    device: str = "cpu"
    schedule: Schedule = field(
        default_factory=lambda: Schedule(updates=9, validate_every=2, checkpoint_every=2)
    )

    def validate(self) -> None:
        self.schedule.validate()


class TinyTrainer:
    """Makes the weights of its head smaller."""

    policy, spec = "diffaero", DIFFAERO_NETWORK

    def __init__(self, config: TinyTraining) -> None:
        self.network = TrainableNetwork(self.spec)
        self.update = 0

    def begin_update(self, update: int) -> None:
        self.update = update

    def losses(self) -> dict[str, torch.Tensor]:
        return {"size": self.network.head.weight.square().sum()}

    def evaluate(self) -> dict[str, float]:
        return {"success": 0.5}

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None:
        pass
