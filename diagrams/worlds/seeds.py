"""Which seeds of generated worlds are for what."""

TRAINING_SEEDS = 1_000_000
"""Training uses seeds from here on, and the benchmark those below: no policy is tested in a world
that it was trained in."""
