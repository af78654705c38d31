"""What policies have in common that learn through the dynamics."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpilot.training.policies.courses import CourseSelection, training_fields, validation_fields
from splatpilot.training.policies.evaluation import FlightConditions, fly_courses
from splatpilot.training.policies.fields import Fields
from splatpilot.training.policies.through_dynamics import FlightSchool, Learner, School
from splatpilot.training.policies.train import Schedule


@dataclass
class FlightTraining:
    """A training run through the dynamics."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    schedule: Schedule = field(default_factory=Schedule)
    courses: CourseSelection = field(default_factory=CourseSelection)
    school: FlightSchool = field(default_factory=FlightSchool)
    # How the flights are that choose among checkpoints.
    validation: FlightConditions = field(default_factory=FlightConditions)
    # [-] Part of the updates, at first, that are flown in worlds without obstacles.
    empty: float = 0.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.schedule.validate()
        self.courses.validate()
        self.school.validate()
        if not 0.0 <= self.empty < 1.0:
            raise ValueError(f"empty is {self.empty}; it must be at least 0 and less than 1")


class FlightTrainee:
    """A `splatpilot.training.policies.train.Trainee` around a learner."""

    def __init__(self, policy: str, learner: Learner, config: FlightTraining) -> None:
        self.policy = policy
        self.network, self.spec = learner.network, learner.network.spec
        self._learner, self._config = learner, config
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        fields = training_fields(config.courses, config.seed, config.device)
        self._validation = validation_fields(config.courses, config.device)
        self._main = self._school(fields)
        self._first_update = round(config.empty * config.schedule.updates)
        self._empty = self._school(fields.emptied()) if self._first_update else None
        self._current = self._main

    def _school(self, fields: Fields) -> School:
        return School(self._learner, fields, self._config.school, self._generator)

    def begin(self, update: int) -> None:
        early = self._empty is not None and update < self._first_update
        self._current = self._empty if early and self._empty is not None else self._main

    def lesson(self) -> dict[str, Tensor]:
        return self._current.lesson()

    def measured(self) -> dict[str, float]:
        config = self._config
        return fly_courses(
            self._learner, self._validation, config.validation, config.school.noise
        ).measures(config.courses.kinds)

    def state(self) -> dict[str, Any]:
        schools = [school for school in (self._main, self._empty) if school is not None]
        return {
            "schools": [school.state() for school in schools],
            "generator": self._generator.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        schools = [school for school in (self._main, self._empty) if school is not None]
        for school, saved in zip(schools, state["schools"], strict=True):
            school.restore(saved)
        self._generator.set_state(state["generator"])
