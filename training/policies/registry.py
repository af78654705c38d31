"""All policies that can be trained, by their names in the benchmark."""

from collections.abc import Callable
from typing import Any, NamedTuple

from splatpilot.training.policies.agile_autonomy import AgileAutonomyTrainer, AgileAutonomyTraining
from splatpilot.training.policies.depthnav import DepthNavLearner, DepthNavTraining
from splatpilot.training.policies.diffaero import DiffAeroLearner, DiffAeroTraining
from splatpilot.training.policies.rollout_trainer import RolloutTrainer
from splatpilot.training.policies.train import Trainer


class Recipe(NamedTuple):
    """How a policy is trained."""

    config: type
    """Its configuration, a dataclass."""
    make: Callable[[Any], Trainer]
    """What that configuration makes."""


def _diffaero(config: DiffAeroTraining) -> Trainer:
    return RolloutTrainer("diffaero", DiffAeroLearner(config.loss, config.device), config)


def _depthnav(config: DepthNavTraining) -> Trainer:
    return RolloutTrainer("depthnav", DepthNavLearner(config.loss, config.device), config)


RECIPES = {
    "diffaero": Recipe(DiffAeroTraining, _diffaero),
    "depthnav": Recipe(DepthNavTraining, _depthnav),
    "agile_autonomy": Recipe(AgileAutonomyTraining, AgileAutonomyTrainer),
}
