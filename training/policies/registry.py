"""All policies that can be trained, by their names in the benchmark."""

from collections.abc import Callable
from typing import Any, NamedTuple

from splatpilot.training.policies.agile_autonomy import AgileTrainee, AgileTraining
from splatpilot.training.policies.depthnav import DepthNavLearner, DepthNavTraining
from splatpilot.training.policies.diffaero import DiffAeroLearner, DiffAeroTraining
from splatpilot.training.policies.flight_trainee import FlightTrainee
from splatpilot.training.policies.train import Trainee


class Recipe(NamedTuple):
    """How a policy is trained."""

    config: type
    """Its configuration, a dataclass."""
    make: Callable[[Any], Trainee]
    """What that configuration makes."""


def _diffaero(config: DiffAeroTraining) -> Trainee:
    return FlightTrainee("diffaero", DiffAeroLearner(config.loss, config.device), config)


def _depthnav(config: DepthNavTraining) -> Trainee:
    return FlightTrainee("depthnav", DepthNavLearner(config.loss, config.device), config)


RECIPES = {
    "diffaero": Recipe(DiffAeroTraining, _diffaero),
    "depthnav": Recipe(DepthNavTraining, _depthnav),
    "agile_autonomy": Recipe(AgileTraining, AgileTrainee),
}
