"""Training by differentiable rollouts, which several policies have in common."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpilot.systems.seeds import first_training_seed
from splatpilot.training.policies.differentiable_rollout import (
    DifferentiableRollout,
    Learner,
    RolloutConfig,
)
from splatpilot.training.policies.evaluation import FlightConditions, evaluate_agent
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.training_worlds import (
    WorldSelection,
    training_worlds,
    validation_worlds,
)
from splatpilot.training.policies.world_batch import WorldBatch


@dataclass
class RolloutTraining:
    """A training run by differentiable rollouts."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    schedule: Schedule = field(default_factory=Schedule)
    worlds: WorldSelection = field(default_factory=WorldSelection)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    # How the flights are that choose among checkpoints.
    validation: FlightConditions = field(default_factory=FlightConditions)
    # [-] Part of the updates, at first, that are flown in worlds without obstacles.
    empty: float = 0.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        first_training_seed(self.seed)
        self.schedule.validate()
        self.worlds.validate()
        self.rollout.validate()
        self.validation.validate()
        if not 0.0 <= self.empty < 1.0:
            raise ValueError(f"empty is {self.empty}; it must be at least 0 and less than 1")


class RolloutTrainer:
    """The `Trainer` of a learner: the loss of rollouts, and the success in held-out worlds."""

    def __init__(self, policy: str, learner: Learner, config: RolloutTraining) -> None:
        self.policy = policy
        self.network, self.spec = learner.network, learner.network.spec
        self._learner, self._config = learner, config
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        worlds = training_worlds(config.worlds, config.seed, config.device)
        self._validation = validation_worlds(config.worlds, config.device)
        self._main = self._rollout(worlds)
        self._first_update = round(config.empty * config.schedule.updates)
        self._empty = self._rollout(worlds.without_obstacles()) if self._first_update else None
        self._current = self._main

    def _rollout(self, worlds: WorldBatch) -> DifferentiableRollout:
        return DifferentiableRollout(self._learner, worlds, self._config.rollout, self._generator)

    def begin_update(self, update: int) -> None:
        early = self._empty is not None and update < self._first_update
        self._current = self._empty if early and self._empty is not None else self._main

    def losses(self) -> dict[str, Tensor]:
        return self._current.losses()

    def evaluate(self) -> dict[str, float]:
        config = self._config
        return evaluate_agent(
            self._learner, self._validation, config.validation, config.rollout.noise
        ).measures(config.worlds.turns)

    def state_dict(self) -> dict[str, Any]:
        rollouts = [rollout for rollout in (self._main, self._empty) if rollout is not None]
        return {
            "rollouts": [rollout.state_dict() for rollout in rollouts],
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        rollouts = [rollout for rollout in (self._main, self._empty) if rollout is not None]
        for rollout, saved in zip(rollouts, state["rollouts"], strict=True):
            rollout.load_state_dict(saved)
        self._generator.set_state(state["generator"])
