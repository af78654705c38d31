import pytest

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.splits import (
    choose_split,
    find_test_source,
    part_digests,
    source_digest,
)

IMAGES = [bytes([k]) * 12 for k in range(40)]


@pytest.fixture(autouse=True)
def hospital(monkeypatch):
    digest = source_digest(part_digests(IMAGES))
    monkeypatch.setattr(splits, "load_test_sources", lambda: {"hospital": digest})


@pytest.mark.parametrize(
    "shown",
    [IMAGES, IMAGES[::-1], IMAGES[::2], [*IMAGES, *(bytes([k, 0]) for k in range(200))]],
    ids=["same", "reversed", "thinned", "longer"],
)
def test_source_is_found_by_its_parts(shown):
    assert find_test_source(part_digests(shown)) == "hospital"


def test_source_of_other_parts_is_not_found():
    digests = part_digests(bytes([k, 1]) for k in range(40))
    assert find_test_source(digests) is None
    assert choose_split("mine", digests, "") == "train"
    assert choose_split("mine", digests, "validation") == "validation"


@pytest.mark.parametrize("asked", ["", "test"])
def test_test_source_is_of_split_test(asked):
    assert choose_split("renamed", part_digests(IMAGES), asked) == "test"


@pytest.mark.parametrize(
    ("digests", "found"), [(part_digests(IMAGES), "train"), ({"0" * 16}, "test")]
)
def test_test_sources_get_no_other_split(digests, found):
    with pytest.raises(ValueError, match="split of renamed must be test, got train"):
        choose_split("renamed", digests, "train", found)


def test_committed_table_has_a_digest_of_every_source(monkeypatch):
    monkeypatch.undo()
    table = splits.load_test_sources()
    assert len(table) == 12
    assert all(len(digest) == 8 for digest in table.values())
