"""The courses that policies train in: of the benchmark's kinds, of seeds that it never uses."""

from collections.abc import Sequence

import numpy as np

from flysplat.diagrams.worlds.forest_config import CLEARANCE, INSET, ForestConfig
from flysplat.diagrams.worlds.forest_layout import lay_out
from flysplat.diagrams.worlds.seeds import TRAINING_SEEDS
from flysplat.training.policies.fields import Course

CourseConfig = ForestConfig

VALIDATION_SEEDS = TRAINING_SEEDS + 500_000
"""Seeds from here on choose among checkpoints and are not trained on either."""


def make_course(config: CourseConfig, seed: int) -> Course:
    """The world of `config` and `seed` as the benchmark flies it, without what cameras see."""
    start = np.array([INSET, 0.0, config.flight_height])
    goal = np.array([config.length - INSET, 0.0, config.flight_height])
    layout = lay_out(config, np.random.default_rng([seed, 0]), [start[:2], goal[:2]], CLEARANCE)
    return Course(layout.shapes(), layout.lower, layout.upper, start, goal)


def training_courses(configs: Sequence[CourseConfig], count: int, first: int) -> list[Course]:
    """`count` courses, in turn of each config, of the seeds from `first` on.

    Raises:
        ValueError: if `first` is below `TRAINING_SEEDS`.
    """
    if first < TRAINING_SEEDS:
        raise ValueError(
            f"training seeds start at {TRAINING_SEEDS}, lower ones as {first} are the benchmark's"
        )
    return [make_course(configs[i % len(configs)], first + i) for i in range(count)]
