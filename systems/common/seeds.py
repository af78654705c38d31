"""Seeds of worlds and flights: each range serves one purpose, and no two ranges overlap.

| seeds | purpose |
|---|---|
| 0 to 99 | development: studies by which policies, worlds and defaults are chosen |
| 1,000 to 999,999 | test: reported studies, after the last change of policies and worlds |
| from 1,000,000 | training, `SEEDS_PER_RUN` a run |
| from 2,000,000 | validation: choose among checkpoints |
| from 3,000,000 | Monte Carlo simulations |
"""

from splatpilot.systems.common.validation import require

TRAINING_SEEDS = 1_000_000
VALIDATION_SEEDS = 2_000_000
SEEDS_PER_RUN = 1000

STUDY_SEEDS = {"dev": range(100), "test": range(1000, TRAINING_SEEDS)}
"""The seeds of a study, by its split."""

SPLIT_NAMES = {"dev": "development", "test": "test"}

MONTE_CARLO_SEEDS = range(3_000_000, 4_000_000)


def study_seeds(split: str, count: int) -> range:
    """Returns the first `count` seeds of a study's split."""
    require(split in STUDY_SEEDS, "split", f"one of {', '.join(STUDY_SEEDS)}", repr(split))
    seeds = STUDY_SEEDS[split]
    require(1 <= count <= len(seeds), f"seeds of split {split}", f"in [1, {len(seeds)}]", count)
    return seeds[:count]


def describe_seeds(split: str, count: int) -> str:
    """Describes the seeds of a study, as "development seeds 0 to 19"."""
    seeds = study_seeds(split, count)
    return f"{SPLIT_NAMES[split]} seeds {seeds[0]} to {seeds[-1]}"


def first_training_seed(run: int) -> int:
    """Returns the first of the `SEEDS_PER_RUN` seeds of a training run, named by its own seed."""
    runs = (VALIDATION_SEEDS - TRAINING_SEEDS) // SEEDS_PER_RUN
    require(0 <= run < runs, "seed", f"in [0, {runs - 1}]", run)
    return TRAINING_SEEDS + run * SEEDS_PER_RUN
