"""Trainers by the names of their policies."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from splatpilot.systems.common.registry import Registry
from splatpilot.training.policies.rollouts import RolloutTrainer
from splatpilot.training.policies.train_agile_autonomy import (
    AgileAutonomyTrainer,
    AgileAutonomyTraining,
)
from splatpilot.training.policies.train_depthnav import DepthNavLearner, DepthNavTraining
from splatpilot.training.policies.train_diffaero import (
    DiffAeroLearner,
    DiffAeroTofLearner,
    DiffAeroTofTraining,
    DiffAeroTraining,
)
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbTrainer, DiffAeroRgbTraining
from splatpilot.training.policies.train_student import (
    StudentDepthTraining,
    StudentRgbTraining,
    StudentTrainer,
)
from splatpilot.training.policies.trainer import Trainer


@dataclass(frozen=True)
class TrainerKind:
    """A registered trainer."""

    config: type
    """Type of its configurations, a dataclass with the fields of `TrainingConfig`."""
    make: Callable[[Any], Trainer]
    """Makes the trainer of a configuration."""


TRAINERS = Registry("trainer", "splatpilot.trainers", TrainerKind)


def register_trainer(name: str, config: type, make: Callable[[Any], Trainer]) -> None:
    """
    Registers a trainer for `splatpilot train`.

    Args:
        name: name of the policy.
        config: type of its configurations, see `splatpilot.training.policies.trainer`.
        make: makes the `Trainer` of a configuration.

    Raises:
        ValueError: if another trainer has the name.
    """
    TRAINERS.add(name, TrainerKind(config, make))


for _name, _config, _learner in (
    ("diffaero", DiffAeroTraining, DiffAeroLearner),
    ("depthnav", DepthNavTraining, DepthNavLearner),
    ("diffaero_tof", DiffAeroTofTraining, DiffAeroTofLearner),
):

    def _make(config: Any, name: str = _name, learner: Any = _learner) -> Trainer:
        return RolloutTrainer(name, learner(config.loss, config.device), config)

    register_trainer(_name, _config, _make)
register_trainer("agile_autonomy", AgileAutonomyTraining, AgileAutonomyTrainer)
register_trainer("diffaero_rgb", DiffAeroRgbTraining, DiffAeroRgbTrainer)
register_trainer("student_rgb", StudentRgbTraining, StudentTrainer)
register_trainer("student_depth", StudentDepthTraining, StudentTrainer)
