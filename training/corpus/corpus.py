"""A corpus: samples to learn from, in shards, and their worlds.

corpus.yaml      every field of its configuration
worlds/NAME/     a world: `world.yaml`, `esdf.npz`
shards/NAME/     samples of one world, see `splatpilot.training.corpus.samples`
ledger.csv       sources of all samples, a row for each flight
"""

import csv
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import (
    folder_written_atomically,
    require_corpus,
    written_atomically,
)
from splatpilot.systems.common.seeds import first_training_seed
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import LibraryConfig, PerturbationConfig, WorldRecord
from splatpilot.training.corpus.samples import OFF_PATH, SOURCES, Samples, SampleSize, Shard


@dataclass
class CorpusConfig(Config):
    """Everything that determines a corpus, except its number of worlds."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    worlds: LibraryConfig = field(default_factory=LibraryConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    # [-] Flights of the expert in each world, all to its goal: the first from its start, the others
    # from anywhere at least half as far away.
    flights: int = bounded(16, "[1, 1000]")
    # [-] States in each world off the expert's paths: anywhere in free space, half of them before a
    # surface; see `training/corpus/collect.py`.
    off_path: int = bounded(0, "[0, 100000]")
    # Camera of the samples.
    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    # [-] How much the appearance of a world changes from flight to flight.
    appearance: float = bounded(1.0, "[0, 1]")

    def check(self) -> None:
        first_training_seed(self.seed)

    @property
    def size(self) -> SampleSize:
        """Size of the samples."""
        return SampleSize(self.camera.height, self.camera.width, self.expert.num_hypotheses)


CONFIG = "corpus.yaml"
LEDGER = "ledger.csv"


class Corpus:
    """The samples of a folder, numbered through its shards in order of their names.

    Images are mapped into memory and read when they are used.

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
        """Copies samples (N,), in the order of `indices`.

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
    """Lists the folders in a folder by name, without those that are being written."""
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
    """Lists the shards of each corpus that none before it has.

    Two are the same if their names and their descriptions, with checksums of all files, are.
    """
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


def write_ledger(folder: Path, corpus: Corpus) -> None:
    """Writes `ledger.csv` from the descriptions of the shards.

    Raises:
        OSError: if it cannot be written.
    """
    rows: list[dict[str, Any]] = []
    for shard in corpus.shards:
        same = {
            "shard": shard.path.name,
            "world": shard.world,
            "source": SOURCES[shard.source],
            "revision": shard.revision,
        }
        rows += [same | flight for flight in shard.flights]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with written_atomically(folder / LEDGER) as path, path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


_PARTS = ("worlds", "world.yaml"), ("shards", "shard.json")  # folders and their descriptions


def link_corpus(source: Path, folder: Path) -> None:
    """Links the content of the corpus `source` that is missing in `folder`.

    Raises:
        ValueError: if `folder` has other content of the same name.
        OSError: if it cannot be written.
    """
    for kind, about in _PARTS:
        for entry in entries(source / kind):
            target = folder / kind / entry.name
            if not target.exists():
                _link_folder(entry, target)
            elif (target / about).read_bytes() != (entry / about).read_bytes():
                raise ValueError(
                    f"{entry} is another than when {target} was made of it; choose another --out"
                )
    if not (folder / CONFIG).exists():
        _link(source / CONFIG, folder / CONFIG)


def _link_folder(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with folder_written_atomically(target) as partial_folder:
        for file in source.iterdir():
            _link(file, partial_folder / file.name)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # on another disk
        with written_atomically(target) as path:
            shutil.copyfile(source, path)
