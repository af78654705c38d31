import pytest

from splatpilot.diagrams.worlds import splits

IMAGES = [bytes([k]) * 12 for k in range(40)]


@pytest.fixture(autouse=True)
def hospital(monkeypatch):
    digest = splits.source_digest(splits.part_digests(IMAGES))
    monkeypatch.setattr(splits, "load_test_sources", lambda: {"hospital": digest})


@pytest.mark.parametrize(
    "shown",
    [IMAGES, IMAGES[::-1], IMAGES[::2], [*IMAGES, *(bytes([k, 0]) for k in range(200))]],
    ids=["same", "reversed", "thinned", "longer"],
)
def test_source_is_found_by_its_parts(shown):
    assert splits.find_test_source(splits.part_digests(shown)) == "hospital"


def test_source_of_other_parts_is_not_found():
    digests = splits.part_digests(bytes([k, 1]) for k in range(40))
    assert splits.find_test_source(digests) is None
    assert splits.choose_split("mine", digests, "") == "train"
    assert splits.choose_split("mine", digests, "validation") == "validation"
    for split in ("", "test"):
        assert splits.choose_split("renamed", splits.part_digests(IMAGES), split) == "test"


@pytest.mark.parametrize(
    ("digests", "found"), [(splits.part_digests(IMAGES), "train"), ({"0" * 16}, "test")]
)
def test_test_sources_get_no_other_split(digests, found):
    with pytest.raises(ValueError, match="split of renamed must be test, got train"):
        splits.choose_split("renamed", digests, "train", found)


def test_committed_table_has_a_digest_of_every_source(monkeypatch):
    monkeypatch.undo()
    table = splits.load_test_sources()
    assert len(table) == 12
    assert all(len(digest) == 8 for digest in table.values())
