"""All policies that can be trained, by their names in the benchmark."""

from collections.abc import Callable
from typing import Any

from flysplat.training.policies.diffaero import DiffAeroTrainee, DiffAeroTraining
from flysplat.training.policies.train import Trainee

TRAINEES: dict[str, tuple[type, Callable[[Any], Trainee]]] = {
    "diffaero": (DiffAeroTraining, DiffAeroTrainee),
}
"""The configuration of each, and what it makes."""
