"""A shard of samples on disk: a folder of three NumPy files and their description.

color.npy    (N, H, W, 3) uint8
depth.npy    (N, H, W) float16
labels.npy   (N,) records, see `SampleSize.label_type`
shard.json   format version, world, source, flights, sizes and checksums
"""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS

# Source of a sample: an expert's flight, the time before a student's near-miss, or free space.
EXPERT, RECOVERY, OFF_PATH = 0, 1, 2
SOURCES = {EXPERT: "expert", RECOVERY: "recovery", OFF_PATH: "off_path"}  # names

SHARD = "shard.json"
FORMAT_VERSION = 2

_ARRAYS = "color", "depth", "labels"
_REMEDY = "delete that folder and run the command that collected it again"


class SampleSize(NamedTuple):
    """Size of a corpus's samples."""

    height: int  # [px]
    width: int  # [px]
    trajectories: int  # K

    def image_types(self) -> dict[str, np.dtype]:
        """Returns the types of one sample's images."""
        return {
            "color": np.dtype((np.uint8, (self.height, self.width, 3))),
            "depth": np.dtype((np.float16, (self.height, self.width))),
        }

    def label_type(self) -> np.dtype:
        """Returns the type of one sample's labels, a record."""
        return np.dtype(
            [
                ("X_WB", "<f8", (7,)),
                ("v_B", "<f4", (3,)),
                ("goal_B", "<f4", (3,)),
                ("trajectories_B", "<f4", (self.trajectories, NUM_WAYPOINTS, 3)),
            ]
        )


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
        label = size.label_type()
        types = size.image_types() | {name: label[name] for name in label.names or ()}
        types |= {"world": np.dtype(np.int32), "source": np.dtype(np.uint8)}
        return cls(**{name: np.zeros(count, dtype) for name, dtype in types.items()})

    def __len__(self) -> int:
        return len(self.color)


def write_shard(
    path: Path,
    parts: Sequence[Samples],
    size: SampleSize,
    *,
    world: str,
    source: int,
    flights: list[dict[str, Any]],
    revision: str,
) -> None:
    """Writes the samples of one world and source to the folder `path` atomically; an existing one
    stays."""
    parts = [Samples.zeros(0, size), *parts]
    count = sum(map(len, parts))
    labels = np.empty(count, size.label_type())
    for name in labels.dtype.names or ():
        labels[name] = np.concatenate([getattr(part, name) for part in parts])
    with folder_written_atomically(path) as folder:
        files = {}
        for name in _ARRAYS:
            file = folder / f"{name}.npy"
            images = name != "labels"
            np.save(file, np.concatenate([getattr(p, name) for p in parts]) if images else labels)
            files[file.name] = {"bytes": file.stat().st_size, "crc32": _checksum(file)}
        about = {
            "format_version": FORMAT_VERSION,
            "revision": revision,
            "world": world,
            "source": source,
            "samples": count,
            "files": files,
            "flights": flights,
        }
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
