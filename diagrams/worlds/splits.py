"""Splits of scenes: training, validation or test, by digests of what they show.

`test_sources.yaml` has those of the sources reserved for tests.
"""

from collections.abc import Collection, Iterable
from functools import cache
from hashlib import blake2b
from pathlib import Path

import yaml

from splatpilot.systems.common.validation import require

SPLITS = "train", "validation", "test"

TABLE = Path(__file__).parent / "test_sources.yaml"


def part_digests(parts: Iterable[bytes]) -> set[str]:
    """Returns a digest of each part of a source: the pixels of an image, a triangle of a mesh."""
    return {blake2b(part, digest_size=8).hexdigest() for part in parts}


def source_digest(digests: Collection[str]) -> list[str]:
    """Returns the eight smallest digests of parts, so that copies are known by most parts."""
    return sorted(digests)[:8]


@cache
def load_test_sources() -> dict[str, list[str]]:
    """Returns the digests of test sources by name, see `benchmarks/test_sources.py`."""
    return yaml.safe_load(TABLE.read_text())


def find_test_source(digests: Collection[str]) -> str | None:
    """Returns the name of the test source that has a part of these digests, if any."""
    for name, kept in load_test_sources().items():
        if not set(kept).isdisjoint(digests):
            return name
    return None


def check_split(split: str) -> None:
    """Checks that a split is known, or empty."""
    require(not split or split in SPLITS, "split", f"one of {', '.join(SPLITS)}", repr(split))


def choose_split(what: str, digests: Collection[str], asked: str, found: str = "train") -> str:
    """Returns the split of a source: the one `asked` for or else `found`; that of test sources is
    always test."""
    name = find_test_source(digests)
    if name is not None:
        found = "test"
    remedy = f"it shows {name}" if name else "the source is of this split"
    require(found != "test" or asked in ("", "test"), f"split of {what}", "test", asked, remedy)
    return asked or found
