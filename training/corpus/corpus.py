"""A corpus: samples to learn from, in shards, and their worlds.

corpus.yaml      every field of its configuration
worlds/NAME/     a world: `world.yaml`, `esdf.npz`
shards/NAME/     samples of one world and source:
  color.npy      (N, H, W, 3) uint8
  depth.npy      (N, H, W) float16
  labels.npy     (N,) records, see `SampleSize.label_type`
  shard.json     format version, world, source, flights, sizes and checksums
ledger.csv       sources of all samples, a row for each flight
"""

import csv
import json
import os
import shutil
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import (
    folder_written_atomically,
    require_corpus,
    write_csv,
    written_atomically,
)
from splatpilot.systems.common.provenance import first_training_seed
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.expert import ExpertConfig
from splatpilot.training.corpus.library import WORLD, LibraryConfig, PerturbationConfig, WorldRecord

CONFIG, LEDGER, SHARD = "corpus.yaml", "ledger.csv", "shard.json"
FORMAT_VERSION = 2

# Source of a sample: an expert's flight, the time before a student's near-miss, or free space.
EXPERT, RECOVERY, OFF_PATH = 0, 1, 2
SOURCES = {EXPERT: "expert", RECOVERY: "recovery", OFF_PATH: "off_path"}  # names

_ARRAYS = "color", "depth", "labels"
_RERUN = "run `splatpilot corpus make` again"
_REMEDY = "delete that folder and run the command that collected it again"


class SampleSize(NamedTuple):
    """Size of a corpus's samples."""

    height: int  # [px]
    width: int  # [px]
    trajectories: int  # K

    def image_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of one sample's images."""
        return {"color": (self.height, self.width, 3), "depth": (self.height, self.width)}

    def label_type(self) -> np.dtype:
        """Returns the type of one sample's labels, a record."""
        trajectories = "trajectories_B", "<f4", (self.trajectories, NUM_WAYPOINTS, 3)
        return np.dtype([("X_WB", "<f8", 7), ("v_B", "<f4", 3), ("goal_B", "<f4", 3), trajectories])


@dataclass(frozen=True, eq=False)
class Samples:
    """N samples. B is the body (x forward, y left, z up) at the pose of the image."""

    color: np.ndarray  # (N, H, W, 3) uint8
    depth: np.ndarray  # (N, H, W) float16 [m], planar z; 0: too near, inf: nothing within range
    X_WB: np.ndarray  # (N, 7) float64, quaternion wxyz and position [m]
    v_B: np.ndarray  # (N, 3) float32 [m/s]
    goal_B: np.ndarray  # (N, 3) float32 [m], p_BG_B, from the body to the goal
    # (N, K, 10, 3) float32 [m], waypoints at 0.1 s to 1.0 s, cheapest first; missing ones are NaN.
    trajectories_B: np.ndarray
    world: np.ndarray  # (N,) int32, index into `Corpus.worlds`
    source: np.ndarray  # (N,) uint8, of `SOURCES`

    @classmethod
    def zeros(cls, count: int, size: SampleSize) -> Self:
        """Allocates `count` samples."""
        labels = np.zeros(count, size.label_type())
        color, depth = size.image_shapes().values()
        return cls(
            np.zeros((count, *color), np.uint8),
            np.zeros((count, *depth), np.float16),
            *(labels[name].copy() for name in labels.dtype.names or ()),
            world=np.zeros(count, np.int32),
            source=np.zeros(count, np.uint8),
        )

    def __len__(self) -> int:
        return len(self.color)


def write_shard(
    path: Path, parts: Sequence[Samples], size: SampleSize, about: dict[str, Any]
) -> None:
    """Writes samples to the folder `path` atomically; an existing one stays. `about` has their
    `world`, `source`, `flights` and `revision`."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in (Samples.zeros(0, size), *parts)])

    labels = np.empty(sum(map(len, parts)), size.label_type())
    for name in labels.dtype.names or ():
        labels[name] = joined(name)
    with folder_written_atomically(path) as folder:
        files = {}
        for name in _ARRAYS:
            file = folder / f"{name}.npy"
            np.save(file, labels if name == "labels" else joined(name))
            files[file.name] = {"bytes": file.stat().st_size, "crc32": _checksum(file)}
        about = {"format_version": FORMAT_VERSION, "samples": len(labels), "files": files} | about
        (folder / SHARD).write_text(json.dumps(about, indent=1) + "\n")


class OtherVersionError(ValueError):
    """A shard has a format version that this program does not know."""


class Shard:
    """A shard on disk. Its arrays are mapped into memory and read as they are used."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            about = json.loads((path / SHARD).read_text())
            version = about["format_version"]
            if version == FORMAT_VERSION:
                self._read(about)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            reason = f"missing {error}" if isinstance(error, KeyError) else error_summary(error)
            raise ValueError(f"{path / SHARD} describes no shard ({reason}); {_REMEDY}") from None
        if version != FORMAT_VERSION:
            raise OtherVersionError(
                f"format version of {path} must be {FORMAT_VERSION}, got {version}; use the "
                "version of the program that collected it, or collect into another folder"
            )
        for name, (size, _) in self._files.items():
            file = path / name
            found = file.stat().st_size if file.is_file() else 0
            require(found == size, f"the size of {file}", f"{size} bytes", found, _REMEDY)

    def _read(self, about: dict[str, Any]) -> None:
        self.revision: str = about["revision"]
        self.world: str = about["world"]
        self.source: int = about["source"]
        self.flights: list[dict[str, Any]] = about["flights"]
        self._count: int = about["samples"]
        files = {f"{name}.npy": about["files"][f"{name}.npy"] for name in _ARRAYS}
        self._files = {name: (file["bytes"], file["crc32"]) for name, file in files.items()}
        require(isinstance(self.world, str), "world", "a name", self.world)
        require(self.source in SOURCES, "source", f"one of {list(SOURCES)}", self.source)
        valid = isinstance(self._count, int) and self._count >= 0
        require(valid, "samples", "at least 0", self._count)
        states = [flight.get("states", 0) for flight in self.flights]
        require(all(isinstance(n, int) for n in states), "states", "whole numbers", states)

    def __len__(self) -> int:
        return self._count

    def verify(self) -> None:
        """Reads everything; raises ValueError for content that has changed since."""
        for name, (_, checksum) in self._files.items():
            if _checksum(self.path / name) != checksum:
                raise ValueError(f"{self.path / name} is damaged (wrong checksum); {_REMEDY}")
        for name, array in self.arrays.items():
            what = f"samples in {self.path / SHARD}"
            require(len(array) == len(self), what, f"{len(array)} as in {name}", len(self), _REMEDY)

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """The fields of `Samples` but `world` and `source`, read-only."""
        if not self._count:  # Empty files cannot be mapped.
            return {}
        color, depth, labels = (np.load(self.path / file, mmap_mode="r") for file in self._files)
        fields = {name: labels[name] for name in labels.dtype.names or ()}
        return {"color": color, "depth": depth} | fields


def _checksum(file: Path) -> int:
    return zlib.crc32(np.memmap(file, np.uint8, mode="r"))


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
    """The samples of a folder, by the names of their shards. Images are mapped into memory."""

    def __init__(self, folder: str | Path) -> None:
        folder = Path(folder)
        require_corpus(folder)
        self.folder = folder
        self.config = load_config(CorpusConfig(), folder / CONFIG)
        self.shards = [Shard(path) for path in subfolders(folder / "shards")]
        self.worlds = [WorldRecord(path) for path in subfolders(folder / "worlds")]
        index = {world.name: k for k, world in enumerate(self.worlds)}
        _require_all(folder / "worlds", {shard.world for shard in self.shards}, index)
        self._filled = [shard for shard in self.shards if len(shard)]
        require(self._filled, f"{folder}", "a corpus with samples", "none", _RERUN)
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
        for shard in self.shards:
            shard.verify()
            for name, size in self.config.size.image_shapes().items() if len(shard) else ():
                given, what = shard.arrays[name].shape[1:], f"images of {shard.path}"
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
        if ((indices < 0) | (indices >= len(self))).any():
            raise IndexError(f"indices of samples must be in [0, {len(self)})")
        found = Samples.zeros(len(indices), self.config.size)
        within = np.searchsorted(self._first, indices, side="right") - 1
        for k in np.unique(within):
            chosen = np.flatnonzero(within == k)
            for name, array in self._filled[k].arrays.items():
                getattr(found, name)[chosen] = array[indices[chosen] - self._first[k]]
            found.world[chosen], found.source[chosen] = self._world[k], self._filled[k].source
        return found


def _require_all(folder: Path, needed: set[str], present: Iterable[str]) -> None:
    if missing := sorted(needed.difference(present)):
        raise ValueError(
            f"No such folder: {folder / missing[0]}, which {LEDGER} or shards name; {_RERUN}"
        )


def subfolders(folder: Path) -> list[Path]:
    """Lists the folders in a folder by name, without those that are being written."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def distinct_worlds(corpora: Sequence[Corpus]) -> dict[str, WorldRecord]:
    """Returns the worlds of corpora by name, each once."""
    records: dict[str, WorldRecord] = {}
    for world in chain(*(corpus.worlds for corpus in corpora)):
        first = records.setdefault(world.name, world)
        if not first.has_same_distances(world):
            raise ValueError(
                f"{first.path} and {world.path} are different worlds of one name; collect one of "
                "the corpora again, with another seed or another name of the file of its kind"
            )
    return records


def distinct_shards(corpora: Sequence[Corpus]) -> list[list[Shard]]:
    """Lists the shards of each corpus whose name and description are not in those before it."""
    seen: dict[tuple[str, bytes], Shard] = {}

    def is_first(shard: Shard) -> bool:
        return seen.setdefault((shard.path.name, (shard.path / SHARD).read_bytes()), shard) is shard

    return [list(filter(is_first, corpus.shards)) for corpus in corpora]


def write_ledger(corpus: Corpus) -> None:
    """Writes `ledger.csv` from the descriptions of the shards."""
    rows = []
    for shard in corpus.shards:
        same = {"shard": shard.path.name, "world": shard.world, "source": SOURCES[shard.source]}
        rows += [same | {"revision": shard.revision} | flight for flight in shard.flights]
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
