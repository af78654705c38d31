"""A corpus: samples to learn from, in shards, and the worlds that they come from.

corpus.yaml      how it is gathered, every field
worlds/NAME/     a world: `world.yaml`, `esdf.npz`
shards/NAME/     samples of one world, see `splatpilot.training.corpus.shard`
ledger.csv       where everything comes from, a row for each flight
"""

import csv
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from splatpilot.systems.configuration import load_config
from splatpilot.systems.environment import require_corpus
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.sample import OFF_PATH, Samples
from splatpilot.training.corpus.shard import Shard
from splatpilot.training.corpus.world_record import WorldRecord

CONFIG = "corpus.yaml"
LEDGER = "ledger.csv"


class Corpus:
    """The samples of a folder, numbered through its shards in order of their names.

    Images are mapped into memory: what is not asked for is not read.

    Raises:
        FileNotFoundError: if there is no corpus.
        ValueError: if a shard or a world is damaged or of another version, naming it and the
            remedy; or if there is not a single sample.
    """

    def __init__(self, folder: Path) -> None:
        require_corpus(folder)
        self.folder = folder
        self.config = load_config(CorpusConfig(), folder / CONFIG)
        self.shards = [Shard(path) for path in entries(folder / "shards")]
        self.worlds: Sequence[WorldRecord] = [
            WorldRecord(path) for path in entries(folder / "worlds")
        ]
        number = {world.name: k for k, world in enumerate(self.worlds)}
        missing = {shard.world for shard in self.shards} - number.keys()
        if missing:
            raise ValueError(
                f"{folder / 'worlds'} lacks {min(missing)}, of which there are samples; run "
                "`splatpilot corpus make` again"
            )
        self._filled = [shard for shard in self.shards if len(shard)]
        if not self._filled:
            raise ValueError(f"{folder} holds no samples yet; run `splatpilot corpus make` again")
        self._world = [number[shard.world] for shard in self._filled]
        self._first = np.cumsum([0, *map(len, self._filled)])

    def __len__(self) -> int:
        return int(self._first[-1])

    def __str__(self) -> str:
        states = sum(flight["states"] for shard in self.shards for flight in shard.flights)
        flown = [shard for shard in self.shards if shard.source != OFF_PATH]
        flights = [flight for shard in flown for flight in shard.flights]
        shown = sum(flight["states"] > 0 for flight in flights)
        return (
            f"{len(self)} samples of {states} states, {shown} of {len(flights)} flights and "
            f"{len(self.worlds)} worlds"
        )

    def verify(self) -> None:
        """Reads all of it.

        Raises:
            FileNotFoundError, ValueError: if what is there is not what was written, or the ledger
                names a shard that is not there.
        """
        for shard in self.shards:
            shard.verify()
            for name, dtype in self.config.size.image_types().items():
                if len(shard) and shard.arrays[name].shape[1:] != dtype.shape:
                    raise ValueError(
                        f"{shard.path} has images of {shard.arrays[name].shape[1:]} pixels, but "
                        f"{self.folder / CONFIG} says {dtype.shape}; restore that file"
                    )
        for world in self.worlds:
            world.esdf()
        ledger = self.folder / LEDGER
        if ledger.is_file():
            with ledger.open(newline="") as file:
                told = {row["shard"] for row in csv.DictReader(file)}
            if lacking := sorted(told - {shard.path.name for shard in self.shards}):
                raise ValueError(
                    f"{self.folder / 'shards'} lacks {lacking[0]}, of which {LEDGER} tells; run "
                    "the command that gathered it again"
                )

    def samples(self, indices: np.ndarray) -> Samples:
        """Copies of the samples of `indices` (N,), in their order.

        Raises:
            IndexError: if one is not from 0 to less than the length.
        """
        indices = np.asarray(indices)
        if len(indices) and not (indices.min() >= 0 and indices.max() < len(self)):
            raise IndexError(f"samples are numbered 0 to {len(self) - 1}")
        found = Samples.zeros(len(indices), self.config.size)
        within = np.searchsorted(self._first, indices, side="right") - 1
        for k in np.unique(within):
            chosen = np.flatnonzero(within == k)
            for name, array in self._filled[k].arrays.items():
                getattr(found, name)[chosen] = array[indices[chosen] - self._first[k]]
            found.world[chosen] = self._world[k]
            found.source[chosen] = self._filled[k].source
        return found


def entries(folder: Path) -> list[Path]:
    """The folders in a folder by name, without those that are only being written."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def distinct_worlds(corpora: Sequence[Corpus]) -> dict[str, WorldRecord]:
    """Returns the worlds of corpora by name, each once.

    Raises:
        ValueError: if two worlds of one name differ in their distances.
    """
    records: dict[str, WorldRecord] = {}
    for world in chain.from_iterable(corpus.worlds for corpus in corpora):
        first = records.setdefault(world.name, world)
        if not first.has_distances_of(world):
            raise ValueError(
                f"{first.path} and {world.path} are different worlds of one name; collect one of "
                "the corpora again, with another seed or another name of the file of its kind"
            )
    return records


def distinct_shards(corpora: Sequence[Corpus]) -> list[list[Shard]]:
    """The shards of each corpus that none before it has: those of two students' recovery link to
    what both began with. The same are two with one name and all that they state, checksums of every
    file among it."""
    seen: set[tuple[str, bytes]] = set()
    kept: list[list[Shard]] = []
    for corpus in corpora:
        kept.append([])
        for shard in corpus.shards:
            what = shard.path.name, (shard.path / "shard.json").read_bytes()
            if what not in seen:
                seen.add(what)
                kept[-1].append(shard)
    return kept
