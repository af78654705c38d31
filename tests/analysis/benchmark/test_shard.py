"""Parts of a study."""

import pytest

from splatpilot.analysis.benchmark.shard import Shard
from splatpilot.analysis.benchmark.study import StudyConfig


@pytest.mark.parametrize("total", [1, 2, 3, 7, 10])
def test_shards_are_a_partition(total):
    """Every flight is in one shard, in order; those through one place stay together; shares differ
    by one place at most.
    """
    config = StudyConfig(["P01", "P02"], ["planner", "straight"], [1.5, 2.0], seeds=5)
    specs = config.rollouts()
    shares = [Shard(number, total).of(specs) for number in range(1, total + 1)]
    assert sorted(spec for share in shares for spec in share) == sorted(specs)
    for share in shares:
        assert share == [spec for spec in specs if spec in share]
    places = [{(spec.scenario, spec.seed) for spec in share} for share in shares]
    assert sum(map(len, places)) == 10
    assert max(map(len, places)) - min(map(len, places)) <= 1


def test_more_shards_than_places_are_refused():
    """None of them is left without a flight."""
    specs = StudyConfig(["P01"], ["planner", "straight"], seeds=3).rollouts()
    with pytest.raises(ValueError, match=r"has 3 places .* dealt out to 4 shards; make it 3"):
        Shard(1, 4).of(specs)


@pytest.mark.parametrize("text", ["", "1", "0/3", "4/3", "a/b", "1/3/4", "-1/3", "1.5/2", "1/"])
def test_bad_shard_is_refused(text):
    """Anything but i/n with i from 1 to n."""
    with pytest.raises(ValueError, match="write i/n"):
        Shard.parse(text)


def test_shard_is_read_as_it_is_written():
    """ "2/8" both ways."""
    assert Shard.parse("2/8") == Shard(2, 8)
    assert str(Shard(2, 8)) == "2/8"
