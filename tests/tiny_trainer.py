from dataclasses import dataclass, field

import torch

from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.trainer import Schedule, Trainer, TrainingConfig


@dataclass
class TinyTraining(TrainingConfig):
    """Nine updates, with a checkpoint after every other one."""

    schedule: Schedule = field(
        default_factory=lambda: Schedule(updates=9, validate_every=2, checkpoint_every=2)
    )


class TinyTrainer(Trainer):
    """Shrinks the weights of a head."""

    policy, spec = "diffaero", DIFFAERO_NETWORK

    def __init__(self, config: TinyTraining) -> None:
        self.network = TrainableNetwork(self.spec)
        self.generator = torch.Generator()
        self.update = 0

    def begin_update(self, update: int) -> None:
        self.update = update

    def losses(self) -> dict[str, torch.Tensor]:
        return {"size": self.network.head.weight.square().sum()}

    def evaluate(self) -> dict[str, float]:
        return {"success": 0.5}
