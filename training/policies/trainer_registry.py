"""All policies that can be trained, by their names."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from splatpilot.systems.common.registry import Registry
from splatpilot.training.policies.rollouts import RolloutTrainer
from splatpilot.training.policies.student_config import StudentDepthTraining, StudentRgbTraining
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
from splatpilot.training.policies.train_student import StudentTrainer
from splatpilot.training.policies.trainer import Trainer


@dataclass(frozen=True)
class TrainerKind:
    """How a policy is trained."""

    config: type
    """The type of its configurations, a dataclass with what `TrainingConfig` has."""
    make: Callable[[Any], Trainer]
    """From a configuration to its trainer."""


TRAINERS = Registry("trainer", "splatpilot.trainers", TrainerKind)
"""All trainers, by the names of their policies."""


def register_trainer(name: str, config: type, make: Callable[[Any], Trainer]) -> None:
    """
    Makes a trainer known, so that `splatpilot train` can name it.

    Args:
        name: of the policy.
        config: the type of its configurations, see `splatpilot.training.policies.trainer`.
        make: from a configuration to a `Trainer`.

    Raises:
        ValueError: if another trainer has the name.
    """
    TRAINERS.add(name, TrainerKind(config, make))


register_trainer(
    "diffaero",
    DiffAeroTraining,
    lambda config: RolloutTrainer("diffaero", DiffAeroLearner(config.loss, config.device), config),
)
register_trainer(
    "depthnav",
    DepthNavTraining,
    lambda config: RolloutTrainer("depthnav", DepthNavLearner(config.loss, config.device), config),
)
register_trainer(
    "diffaero_tof",
    DiffAeroTofTraining,
    lambda config: RolloutTrainer(
        "diffaero_tof", DiffAeroTofLearner(config.loss, config.device), config
    ),
)
register_trainer("agile_autonomy", AgileAutonomyTraining, AgileAutonomyTrainer)
register_trainer("diffaero_rgb", DiffAeroRgbTraining, DiffAeroRgbTrainer)
register_trainer("student_rgb", StudentRgbTraining, StudentTrainer)
register_trainer("student_depth", StudentDepthTraining, StudentTrainer)
