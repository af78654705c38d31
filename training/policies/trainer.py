"""What trains a policy, and how long."""

from dataclasses import dataclass
from typing import Any, Protocol

import torch


@dataclass
class Schedule:
    """How long training takes and what it leaves."""

    # [-] Steps of the optimiser.
    updates: int = 1400
    # [-] Updates between two measurements of the success on held-out worlds; the weights of the
    # best are kept.
    validate_every: int = 200
    # [-] Updates between two checkpoints that training goes on from when it was interrupted, and
    # between two rows of the curves.
    checkpoint_every: int = 100
    # [-] Step size of AdamW, which falls to nothing over the last part `decay` of the updates.
    learning_rate: float = 1e-3
    # [-] Last part of the updates, over which the step size falls.
    decay: float = 0.3
    # [-] AdamW's decay of the weights.
    weight_decay: float = 0.01
    # [-] Greatest norm of the gradient.
    clip: float = 1.0
    # Whether curves are also written for TensorBoard.
    tensorboard: bool = False

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("updates", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"schedule.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("learning_rate", "clip"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ValueError(f"schedule.{name} is {getattr(self, name)}; it must be positive")
        if not 0.0 <= self.decay <= 1.0:
            raise ValueError(f"schedule.decay is {self.decay}; it must be between 0 and 1")

    def due(self, update: int) -> tuple[bool, bool]:
        """Whether to keep a checkpoint after an update, and whether to measure the success: also
        with the first checkpoint, so that curves and weights are there early, and at the end."""
        keep, last = update % self.checkpoint_every == 0, update == self.updates
        measure = update % self.validate_every == 0 or update == self.checkpoint_every
        return keep or last, measure or last

    def factor(self, update: int) -> float:
        """What the step size is multiplied by at an update."""
        left = (self.updates - update) / max(self.decay * self.updates, 1e-9)
        return min(1.0, max(left, 0.02))


class TrainingConfig(Protocol):
    """What every trainer's configuration, a dataclass with defaults, has beside its own."""

    seed: int
    device: str
    schedule: Schedule

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        ...


FLIGHTS = """\
Flown in simulation as in training. `success` is the part that reached the goal; `collisions` and
`left` (the volume) are the failures that are not for lack of time; a scenario's name stands before
the success in worlds of its kind."""
"""What `evaluate` measures, where a trainer's own `measures` does not say that it is other."""


class Trainer(Protocol):
    """What trains one policy, whatever it learns from. It may have `measures`, a text for the model
    card on what `evaluate` measures, see `FLIGHTS`, and `evaluated`, of what `success` is a part:
    "flights" if it has none; and `take_part(rank, count)`, after which
    `losses` are of one of `count` equal parts of every batch, so that processes learn together; and
    `learns_from`, a text that tells the content of the files that it reads from all others, without
    which an interrupted run would go on with files that have changed."""

    policy: str
    """Name of the policy, and of its file of weights."""
    spec: Any
    """The network's architecture, a dataclass, which the file states and `PolicyCheckpoint.load`
    asks for."""

    @property
    def network(self) -> torch.nn.Module:
        """What is trained."""
        ...

    def begin_update(self, update: int) -> None:
        """Called before each update with its number."""
        ...

    def losses(self) -> dict[str, torch.Tensor]:
        """The terms of the loss, differentiable by the network's weights, and what else the curves
        are to show, which has no gradient."""
        ...

    def evaluate(self) -> dict[str, float]:
        """Success and more on held-out worlds; `success` chooses among checkpoints."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything but weights that the next losses depend on: tensors, numbers and text, in
        lists and dictionaries."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The inverse of `state_dict`."""
        ...
