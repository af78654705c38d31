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
    write_csv,
    written_atomically,
)
from splatpilot.systems.common.provenance import first_training_seed
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import WORLD, LibraryConfig, PerturbationConfig, WorldRecord
from splatpilot.training.corpus.samples import OFF_PATH, SHARD, SOURCES, Samples, SampleSize, Shard

CONFIG = "corpus.yaml"
LEDGER = "ledger.csv"

_REMEDY = "run `splatpilot corpus make` again"


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
        return SampleSize(self.camera.height, self.camera.width, self.expert.num_hypotheses)


class Corpus:
    """The samples of a folder, indexed through its shards in order of their names. Images are
    mapped into memory and read as they are used."""

    def __init__(self, folder: Path) -> None:
        require_corpus(folder)
        self.folder = folder
        self.config = load_config(CorpusConfig(), folder / CONFIG)
        self.shards = [Shard(path) for path in subfolders(folder / "shards")]
        self.worlds = [WorldRecord(path) for path in subfolders(folder / "worlds")]
        index = {world.name: k for k, world in enumerate(self.worlds)}
        _require_all(folder / "worlds", {shard.world for shard in self.shards}, index)
        self._filled = [shard for shard in self.shards if len(shard)]
        require(self._filled, f"{folder}", "a corpus with samples", "none", _REMEDY)
        self._world = [index[shard.world] for shard in self._filled]
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
        """Reads everything; raises an error for content that has changed since."""
        types = self.config.size.image_types()
        for shard in self.shards:
            shard.verify()
            for name in types if len(shard) else ():
                size, given = types[name].shape, shard.arrays[name].shape[1:]
                what = f"images of {shard.path}"
                require(given == size, what, f"{size} as in {self.folder / CONFIG}", given)
        for world in self.worlds:
            _ = world.esdf
        ledger = self.folder / LEDGER
        if ledger.is_file():
            with ledger.open(newline="") as file:
                listed = {row["shard"] for row in csv.DictReader(file)}
            _require_all(self.folder / "shards", listed, {s.path.name for s in self.shards})

    def samples(self, indices: np.ndarray) -> Samples:
        """Copies samples (N,), in the order of `indices`."""
        indices = np.asarray(indices)
        if len(indices) and not (indices.min() >= 0 and indices.max() < len(self)):
            raise IndexError(f"indices of samples must be in [0, {len(self)})")
        found = Samples.zeros(len(indices), self.config.size)
        within = np.searchsorted(self._first, indices, side="right") - 1
        for k in np.unique(within):
            chosen = np.flatnonzero(within == k)
            for name, array in self._filled[k].arrays.items():
                getattr(found, name)[chosen] = array[indices[chosen] - self._first[k]]
            found.world[chosen] = self._world[k]
            found.source[chosen] = self._filled[k].source
        return found


def _require_all(folder: Path, needed: set[str], present: Any) -> None:
    if missing := sorted(needed.difference(present)):
        raise ValueError(
            f"No such folder: {folder / missing[0]}, which {LEDGER} or shards name; {_REMEDY}"
        )


def subfolders(folder: Path) -> list[Path]:
    """Lists the folders in a folder by name, without those that are being written."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def distinct_worlds(corpora: Sequence[Corpus]) -> dict[str, WorldRecord]:
    """Returns the worlds of corpora by name, each once."""
    records: dict[str, WorldRecord] = {}
    for world in chain.from_iterable(corpus.worlds for corpus in corpora):
        first = records.setdefault(world.name, world)
        if not first.has_same_distances(world):
            raise ValueError(
                f"{first.path} and {world.path} are different worlds of one name; collect one of "
                "the corpora again, with another seed or another name of the file of its kind"
            )
    return records


def distinct_shards(corpora: Sequence[Corpus]) -> list[list[Shard]]:
    """Lists the shards of each corpus that are not in those before it. Shards are equal if their
    names and descriptions are, which have checksums of all files."""
    seen: set[tuple[str, bytes]] = set()
    kept: list[list[Shard]] = []
    for corpus in corpora:
        kept.append([])
        for shard in corpus.shards:
            key = shard.path.name, (shard.path / SHARD).read_bytes()
            if key not in seen:
                seen.add(key)
                kept[-1].append(shard)
    return kept


def write_ledger(corpus: Corpus) -> None:
    """Writes `ledger.csv` from the descriptions of the shards."""
    rows: list[dict[str, Any]] = []
    for shard in corpus.shards:
        same = {
            "shard": shard.path.name,
            "world": shard.world,
            "source": SOURCES[shard.source],
            "revision": shard.revision,
        }
        rows += [same | flight for flight in shard.flights]
    write_csv(corpus.folder / LEDGER, rows)


def link_corpus(source: Path, folder: Path) -> None:
    """Links the content of the corpus `source` that is missing in `folder`."""
    for kind, about in (("worlds", WORLD), ("shards", SHARD)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for entry in subfolders(source / kind):
            target = folder / kind / entry.name
            if not target.exists():
                with folder_written_atomically(target) as linked:
                    shutil.copytree(entry, linked, copy_function=_link, dirs_exist_ok=True)
            elif (target / about).read_bytes() != (entry / about).read_bytes():
                raise ValueError(
                    f"{entry} has changed since {target} was made of it; choose another --out"
                )
    if not (folder / CONFIG).exists():
        with written_atomically(folder / CONFIG) as path:
            shutil.copyfile(source / CONFIG, path)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # on another disk
        shutil.copyfile(source, target)
