"""A block of samples on disk: a folder of three arrays, and `shard.json`, which says whose.

    color.npy    (N, H, W, 3) uint8
    depth.npy    (N, H, W) float16
    labels.npy   (N,) records, see `SampleSize.label_type`
    shard.json   format version, world, source, flights, sizes and checksums

The folder appears whole, by one renaming. The arrays are in NumPy's own format: specified,
unchanged since 2007, read by every language, and mapped into memory by NumPy itself.
"""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.lib.format import dtype_to_descr, write_array_header_1_0

from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.readers import reason_of
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS

EXPERT, RECOVERY, OFF_PATH = 0, 1, 2
"""Where a sample comes from: a flight of the expert, the time before a student's near-miss, or
anywhere in free space."""

SOURCES = {EXPERT: "expert", RECOVERY: "recovery", OFF_PATH: "off_path"}
"""Their names."""


class SampleSize(NamedTuple):
    """What samples of one corpus have in common."""

    height: int  # [px]
    width: int  # [px]
    trajectories: int  # K

    def image_types(self) -> dict[str, np.dtype]:
        """The types of one sample's images."""
        return {
            "color": np.dtype((np.uint8, (self.height, self.width, 3))),
            "depth": np.dtype((np.float16, (self.height, self.width))),
        }

    def label_type(self) -> np.dtype:
        """The type of everything else that is one sample's own, a record."""
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
    """N samples. B is the body (x forward, y left, z up) at the pose that was rendered from."""

    color: np.ndarray  # (N, H, W, 3) uint8
    depth: np.ndarray  # (N, H, W) float16 [m], planar z; 0: too near, inf: nothing within range
    X_WB: np.ndarray  # (N, 7) float64, quaternion wxyz and position [m]
    v_B: np.ndarray  # (N, 3) float32 [m/s]
    goal_B: np.ndarray  # (N, 3) float32 [m], p_BG_B, from the body to the goal
    # (N, K, 10, 3) float32 [m], waypoints at 0.1 s to 1.0 s, cheapest first; NaN where there are
    # fewer than K.
    trajectories_B: np.ndarray
    world: np.ndarray  # (N,) int32, index into `Corpus.worlds`
    source: np.ndarray  # (N,) uint8, of `SOURCES`

    @classmethod
    def zeros(cls, count: int, size: SampleSize) -> Self:
        """`count` samples to be written to."""
        label = size.label_type()
        types = size.image_types() | {name: label[name] for name in label.names or ()}
        types |= {"world": np.dtype(np.int32), "source": np.dtype(np.uint8)}
        return cls(**{name: np.zeros(count, dtype) for name, dtype in types.items()})

    @property
    def size(self) -> SampleSize:
        """What they have in common."""
        _, height, width = self.depth.shape
        return SampleSize(height, width, self.trajectories_B.shape[1])

    def __len__(self) -> int:
        return len(self.color)


FORMAT_VERSION = 2

_ABOUT = "shard.json"
_ARRAYS = "color.npy", "depth.npy", "labels.npy"
_REMEDY = "delete that folder and run the command that gathered it again"
_CHUNK = 1 << 22  # bytes


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
    """
    Writes the folder `path`, whole or not at all; one that is there stays.

    Args:
        parts: what to write, one after the other, perhaps none; their `world` and `source` are
            stated once:
        size: theirs.
        world: name of the world that all are from.
        source: one of `SOURCES`, of all.
        flights: of each flight that they come from, what JSON can hold.
        revision: of the program.

    Raises:
        OSError: if it cannot be written.
    """
    with folder_written_atomically(path) as folder:
        for name, dtype in (size.image_types() | {"labels": size.label_type()}).items():
            _write_array(folder / f"{name}.npy", dtype, [_column(part, name) for part in parts])
        files = {
            name: {"bytes": (folder / name).stat().st_size, "crc32": _checksum(folder / name)}
            for name in _ARRAYS
        }
        about = {
            "format_version": FORMAT_VERSION,
            "revision": revision,
            "world": world,
            "source": source,
            "samples": sum(map(len, parts)),
            "files": files,
            "flights": flights,
        }
        (folder / _ABOUT).write_text(json.dumps(about, indent=1) + "\n")


class OtherVersionError(ValueError):
    """A shard is whole, and of a version that this program does not know."""


class Shard:
    """A shard that is there. Its arrays are mapped when first asked for, and read as they are used.

    Raises:
        OtherVersionError: if it is of another version.
        ValueError: if a file is missing, damaged or cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            about = json.loads((path / _ABOUT).read_text())
            version = about["format_version"]
            if version != FORMAT_VERSION:
                raise OtherVersionError(
                    f"{path}: a shard of format version {version}, this program knows "
                    f"{FORMAT_VERSION}; use the version of the program that gathered it, or gather "
                    "anew in another folder"
                )
            self.revision: str = about["revision"]
            self.world: str = about["world"]
            self.source: int = about["source"]
            self.flights: list[dict[str, Any]] = about["flights"]
            self._files: dict[str, dict[str, int]] = {
                name: {key: about["files"][name][key] for key in ("bytes", "crc32")}
                for name in _ARRAYS
            }
            self._count: int = about["samples"]
            _check_types(self)
        except OtherVersionError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            wrong = f"it lacks {error}" if isinstance(error, KeyError) else reason_of(error)
            raise ValueError(f"{path / _ABOUT} describes no shard ({wrong}); {_REMEDY}") from None
        for name, said in self._files.items():
            file = path / name
            found = file.stat().st_size if file.is_file() else 0
            if found != said["bytes"]:
                raise ValueError(f"{file} has {found} bytes instead of {said['bytes']}; {_REMEDY}")

    def __len__(self) -> int:
        return self._count

    def verify(self) -> None:
        """Reads all of it.

        Raises:
            ValueError: if what is there is not what was written.
        """
        for name, said in self._files.items():
            if _checksum(self.path / name) != said["crc32"]:
                raise ValueError(f"{self.path / name} is damaged (wrong checksum); {_REMEDY}")
        for name, array in self.arrays.items():
            if len(array) != len(self):
                raise ValueError(
                    f"{self.path / _ABOUT} says that there are {len(self)} samples, where "
                    f"{name} has {len(array)}; {_REMEDY}"
                )

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """The fields of `Samples` that samples do not share, read-only."""
        if not self._count:  # nothing cannot be mapped
            return {}
        color, depth, labels = (np.load(self.path / name, mmap_mode="r") for name in _ARRAYS)
        fields = {name: labels[name] for name in labels.dtype.names or ()}
        return {"color": color, "depth": depth} | fields


def _check_types(shard: Shard) -> None:
    """Raises ValueError unless what a shard's description says can be."""
    count, flights = shard._count, shard.flights
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"samples is {count!r}")
    if not isinstance(shard.source, int) or not 0 <= shard.source < len(SOURCES):
        raise ValueError(f"source is {shard.source!r}")
    if not isinstance(shard.world, str):
        raise ValueError(f"world is {shard.world!r}")
    if not all(isinstance(flight.get("states", 0), int) for flight in flights):
        raise ValueError("a flight's number of states is no integer")


def _column(samples: Samples, name: str) -> np.ndarray:
    """What one file of a shard has of samples."""
    if name != "labels":
        return getattr(samples, name)
    labels = np.empty(len(samples), samples.size.label_type())
    for field in labels.dtype.names or ():
        labels[field] = getattr(samples, field)
    return labels


def _write_array(file: Path, dtype: np.dtype, parts: Sequence[np.ndarray]) -> None:
    """Writes arrays as the one that `np.save` writes of all of them, which is never in memory."""
    header = {
        "descr": dtype_to_descr(dtype.base),
        "fortran_order": False,
        "shape": (sum(map(len, parts)), *dtype.shape),
    }
    with file.open("wb") as stream:
        write_array_header_1_0(stream, header)
        for part in parts:
            part.tofile(stream)


def _checksum(file: Path) -> int:
    value = 0
    with file.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            value = zlib.crc32(chunk, value)
    return value
