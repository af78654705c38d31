"""Seeds of the benchmark, of training and of validation."""

import pytest

from splatpilot.systems.seeds import (
    SEEDS_PER_RUN,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    first_training_seed,
)


def test_runs_fill_the_seeds_between_benchmark_and_validation():
    """The seeds of the thousand runs follow each other without gap or overlap, from the first that
    the benchmark leaves to the last before validation's."""
    firsts = [first_training_seed(run) for run in range(1000)]
    assert firsts == list(range(TRAINING_SEEDS, VALIDATION_SEEDS, SEEDS_PER_RUN))


@pytest.mark.parametrize("run", [-1, 1000])
def test_run_without_seeds_of_its_own_is_refused(run):
    """Runs are numbered from 0 to 999; others would take seeds of the benchmark or validation."""
    with pytest.raises(ValueError, match=rf"seed .*999\], got {run}"):
        first_training_seed(run)
