from itertools import combinations

import pytest

from splatpilot.systems.common.provenance import (
    MONTE_CARLO_SEEDS,
    SEEDS_PER_RUN,
    STUDY_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    first_training_seed,
    study_seeds,
)


def test_runs_fill_the_seeds_between_benchmark_and_validation():
    """The seeds of the thousand runs follow each other without gap or overlap, from the first that
    the benchmark leaves to the last before validation's."""
    firsts = [first_training_seed(run) for run in range(1000)]
    assert firsts == list(range(TRAINING_SEEDS, VALIDATION_SEEDS, SEEDS_PER_RUN))


def test_ranges_of_seeds_do_not_overlap():
    training = range(TRAINING_SEEDS, first_training_seed(999) + SEEDS_PER_RUN)
    validation = range(VALIDATION_SEEDS, VALIDATION_SEEDS + SEEDS_PER_RUN)
    ranges = [*STUDY_SEEDS.values(), training, validation, MONTE_CARLO_SEEDS]
    for a, b in combinations(ranges, 2):
        assert a[-1] < b[0] or b[-1] < a[0]


@pytest.mark.parametrize("run", [-1, 1000])
def test_run_without_seeds_of_its_own_is_refused(run):
    with pytest.raises(ValueError, match=rf"seed .*999\], got {run}"):
        first_training_seed(run)


@pytest.mark.parametrize(("split", "count"), [("dev", 101), ("test", 999_001), ("dev", 0)])
def test_more_seeds_than_a_split_has_are_refused(split, count):
    with pytest.raises(ValueError, match=f"got {count}"):
        study_seeds(split, count)
