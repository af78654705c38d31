"""Whose the seeds of worlds are: the benchmark's, training's or validation's, never two of them.

The benchmark flies in worlds of seeds below `TRAINING_SEEDS`. Those from 0 on are in its tables,
and by what they showed policies, worlds and recipes were mended; by those from `FRESH_SEEDS` on
nothing was. From `TRAINING_SEEDS` on each run of training has `SEEDS_PER_RUN` of its own; those
from `VALIDATION_SEEDS` on choose among checkpoints.
"""

from splatpilot.systems.messages import require

MAX_SEED = 2**31 - 1
FRESH_SEEDS = 500_000
TRAINING_SEEDS = 1_000_000
VALIDATION_SEEDS = 2_000_000
SEEDS_PER_RUN = 1000


def check_seed(seed: int) -> None:
    """Raises ValueError unless a seed is in [0, `MAX_SEED`]."""
    require(0 <= seed <= MAX_SEED, "seed", f"in [0, {MAX_SEED}]", seed)


def first_training_seed(run: int) -> int:
    """The first of the `SEEDS_PER_RUN` seeds that a run of training has, named by its own seed.

    Raises:
        ValueError: for a run whose seeds would reach into those of validation.
    """
    runs = (VALIDATION_SEEDS - TRAINING_SEEDS) // SEEDS_PER_RUN
    require(0 <= run < runs, "seed", f"in [0, {runs - 1}]", run)
    return TRAINING_SEEDS + run * SEEDS_PER_RUN
