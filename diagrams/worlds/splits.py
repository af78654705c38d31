"""
What scenes are for: to train in, to validate in, or to test in.

A split belongs to what a scene shows, whatever its files are called. So a scene states digests of
its source, and `test_sources.yaml` has those of the sources that are only tested in.
"""

from collections.abc import Collection, Iterable
from functools import cache
from hashlib import blake2b
from pathlib import Path

import yaml

SPLITS = "train", "validation", "test"

TABLE = Path(__file__).parent / "test_sources.yaml"
_KEPT = 8


def part_digests(parts: Iterable[bytes]) -> set[str]:
    """Returns a digest of each part of a source: the pixels of an image, a triangle of a mesh."""
    return {blake2b(part, digest_size=8).hexdigest() for part in parts}


def source_digest(digests: Collection[str]) -> list[str]:
    """
    Returns the digest of a source: the eight smallest of its parts' digests.

    It depends neither on names nor on order. Two sources are taken for one if a part of either is
    among the eight of the other, so copies with parts missing or added are recognized.
    """
    return sorted(digests)[:_KEPT]


@cache
def load_test_sources() -> dict[str, list[str]]:
    """Returns the digests of the sources that are only tested in, by name;
    `benchmarks/test_sources.py` writes their file."""
    return yaml.safe_load(TABLE.read_text())


def find_test_source(digests: Collection[str]) -> str | None:
    """Returns the name of the test source that has a part of these digests; None if none has."""
    for name, kept in load_test_sources().items():
        if not set(kept).isdisjoint(digests):
            return name
    return None


def check_split(split: str) -> None:
    """Raises ValueError for an unknown split; empty is known."""
    if split and split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")


def choose_split(what: str, digests: Collection[str], asked: str, found: str = "train") -> str:
    """
    Returns the split of a source.

    Args:
        what: the source, for messages.
        digests: of its parts.
        asked: the split that the user gives it; empty for none.
        found: the split that it has otherwise, unless it is a test source.

    Raises:
        ValueError: if `asked` is another split than test for what is only tested in.
    """
    name = find_test_source(digests)
    if name is not None:
        found = "test"
    if found == "test" and asked not in ("", "test"):
        shown = f"it shows {name}" if name else "it says so"
        raise ValueError(f"split of {what} must be test, got {asked}: {shown}")
    return asked or found
