"""Interfaces between the training loop and what is trained."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpilot.systems.common.validation import Config, bounded, check_seed, require_field
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.policies.augmentation import Appearance


@dataclass
class Schedule(Config):
    """Duration and outputs of training."""

    # [-] Steps of the optimizer.
    updates: int = bounded(1400, "[1, inf)")
    # [-] Updates between two evaluations in held-out worlds, which select the weights.
    validate_every: int = bounded(200, "[1, inf)")
    # [-] Updates between two checkpoints for resuming, and between two rows of the curves.
    checkpoint_every: int = bounded(100, "[1, inf)")
    # [-] Learning rate of AdamW.
    learning_rate: float = bounded(1e-3, "(0, inf)")
    # [-] Last fraction of the updates, over which the learning rate falls.
    decay: float = bounded(0.3, "[0, 1]")
    # [-] Weight decay of AdamW.
    weight_decay: float = 0.01
    # [-] Maximum norm of the gradient.
    clip: float = bounded(1.0, "(0, inf)")
    # Also writes curves for TensorBoard.
    tensorboard: bool = False

    def due(self, update: int) -> tuple[bool, bool]:
        """Tells whether to write a checkpoint and to evaluate, as after the first checkpoint."""
        last = update == self.updates
        evaluate = update % self.validate_every == 0 or update == self.checkpoint_every
        return last or update % self.checkpoint_every == 0, last or evaluate

    def factor(self, update: int) -> float:
        """Computes the factor of the learning rate at an update."""
        left = (self.updates - update) / max(self.decay * self.updates, 1e-9)
        return min(1.0, max(left, 0.02))


@dataclass
class TrainingConfig(Config):
    """Fields of every trainer's configuration."""

    # Seed of everything random.
    seed: int = 0
    # Device of the tensors: cpu, or cuda.
    device: str = "cpu"
    schedule: Schedule = field(default_factory=Schedule)


@dataclass
class CorpusTraining(TrainingConfig):
    """Fields of trainers that learn from corpora."""

    # Folders of the corpora, see `splatpilot corpus make`.
    corpora: list[str] = field(default_factory=lambda: ["out/corpus"])
    # [-] Fraction of the worlds, by name, that select among checkpoints instead.
    held_out: float = bounded(0.1, "[0, 0.9]")
    # [-] Samples per step of the optimizer.
    batch: int = bounded(32, "[1, inf)")
    # File of this policy's weights to continue from; none if empty.
    begin: str = ""
    # Changes of the appearance of images.
    appearance: Appearance = field(default_factory=Appearance)
    # Noise of images.
    noise: ObservationNoise = field(default_factory=ObservationNoise)

    def check(self) -> None:
        require_field(self, "corpora", self.corpora, "one folder of a corpus or more")
        check_seed(self.seed)


FLIGHTS = """\
Flown in simulation as in training. `success` is the fraction that reached the goal; `collisions`
and `left` (the volume) are failures, as is running out of time; rows named by a scenario are the
success in its kind of worlds."""


class Trainer:
    """Base class of trainers: the network of a policy, the terms of its loss and its evaluation."""

    policy: str  # name of the policy, and of its file of weights
    spec: Any  # architecture of the network, a dataclass, see `PolicyCheckpoint`
    network: Any  # torch.nn.Module
    generator: torch.Generator  # source of all random numbers of the losses
    # Digest of the files that it reads. A run is not resumed if they have changed.
    learns_from: str = ""
    evaluated: str = "flights"  # counted by `success`
    metrics: str = FLIGHTS  # description of the results of `evaluate` for the model card

    def begin_update(self, update: int) -> None:
        """Prepares an update; called with its number."""

    def losses(self) -> dict[str, Tensor]:
        """Computes the terms of the loss; entries without gradient are only plotted."""
        raise NotImplementedError

    def evaluate(self) -> dict[str, float]:
        """Measures `success`, which selects among checkpoints, and more in held-out worlds."""
        raise NotImplementedError

    def state_dict(self) -> dict[str, Any]:
        """Returns the state, without weights, of the next losses: tensors, numbers and text."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the result of `state_dict`."""
        self.generator.set_state(state["generator"])
