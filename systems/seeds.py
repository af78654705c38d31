"""Whose the seeds of worlds are: the benchmark's, training's or validation's, never two of them.

The benchmark flies in worlds of seeds below `TRAINING_SEEDS`. Those from 0 on are in its tables,
and by what they showed policies, worlds and recipes were mended; by those from `FRESH_SEEDS` on
nothing was. From `TRAINING_SEEDS` on each run of training has `SEEDS_PER_RUN` of its own; those
from `VALIDATION_SEEDS` on choose among checkpoints.
"""

FRESH_SEEDS = 500_000
TRAINING_SEEDS = 1_000_000
VALIDATION_SEEDS = 2_000_000
SEEDS_PER_RUN = 1000


def first_training_seed(run: int) -> int:
    """The first of the `SEEDS_PER_RUN` seeds that a run of training has, named by its own seed.

    Raises:
        ValueError: for a run whose seeds would reach into those of validation.
    """
    runs = (VALIDATION_SEEDS - TRAINING_SEEDS) // SEEDS_PER_RUN
    if not 0 <= run < runs:
        raise ValueError(f"seed is {run}; it must be 0 to {runs - 1}")
    return TRAINING_SEEDS + run * SEEDS_PER_RUN
