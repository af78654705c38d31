"""Trainers by the names of their policies."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

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
from splatpilot.training.policies.train_distilled_rgb import (
    DistilledRgbTrainer,
    DistilledRgbTraining,
)
from splatpilot.training.policies.train_student import (
    StudentDepthTraining,
    StudentRgbTraining,
    StudentTrainer,
)
from splatpilot.training.policies.trainer import Trainer


class TrainerEntry(NamedTuple):
    """A registered trainer."""

    config: type  # of its configurations, a dataclass with the fields of `TrainingConfig`
    make: Callable[[Any], Trainer]  # makes the trainer of a configuration


TRAINERS = Registry("trainer", "splatpilot.trainers", TrainerEntry)


def register_trainer(name: str, config: type, make: Callable[[Any], Trainer]) -> None:
    """Registers the trainer of a policy for `splatpilot train`: the type of its configurations, see
    `splatpilot.training.policies.trainer`, and what makes the `Trainer` of one."""
    TRAINERS.add(name, TrainerEntry(config, make))


def _rollout_trainer(name: str, learner: Any, config: Any) -> Trainer:
    return RolloutTrainer(name, learner(config.loss, config.device), config)


for _name, _config, _learner in (
    ("diffaero", DiffAeroTraining, DiffAeroLearner),
    ("depthnav", DepthNavTraining, DepthNavLearner),
    ("diffaero_tof", DiffAeroTofTraining, DiffAeroTofLearner),
):
    register_trainer(_name, _config, partial(_rollout_trainer, _name, _learner))
register_trainer("agile_autonomy", AgileAutonomyTraining, AgileAutonomyTrainer)
register_trainer("diffaero_rgb", DiffAeroRgbTraining, DiffAeroRgbTrainer)
register_trainer("distilled_rgb", DistilledRgbTraining, DistilledRgbTrainer)
register_trainer("student_rgb", StudentRgbTraining, StudentTrainer)
register_trainer("student_depth", StudentDepthTraining, StudentTrainer)
