"""Times of arrival in training worlds, kept in the user's cache: they take longest to make."""

import contextlib
import os
from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path

import numpy as np

from splatpilot.systems.array_files import read_archive
from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_from_distance_field import esdf_from_distance_field
from splatpilot.systems.collision.shapes import Shape
from splatpilot.systems.environment import cache_folder
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.provenance import program

_LIMIT = 1 << 30
"""[bytes] that files of the cache may take; those that were used last stay."""


class ArrivalCache:
    """Makes, or reads again, the distances in worlds and the times of arrival at their goals.

    What this program would make is the same to the last bit. Where the cache cannot be written
    nothing is kept.
    """

    def __init__(self) -> None:
        self._folder = cache_folder("arrivals")
        self._program = repr(program()).encode()
        with contextlib.suppress(OSError):
            require_writable_folder(self._folder)

    def arrival(
        self,
        surfaces: Sequence[Shape] | Esdf,
        lower_W: np.ndarray,
        upper_W: np.ndarray,
        p_WG: np.ndarray,
        voxel_size: float,
    ) -> tuple[Esdf, TimeOfArrival]:
        """Returns the conservative distances and the times of arrival in a world.

        Args:
            surfaces: shapes, or the distances of a captured environment.
            lower_W, upper_W: (3,) [m], the volume.
            p_WG: (3,) [m], the goal.
            voxel_size: [m], of both grids.

        Raises:
            InfeasibleFlightError: see `time_of_arrival`.
        """
        key = blake2b(self._program, digest_size=16)
        for part in (lower_W, upper_W, p_WG, voxel_size, *_content(surfaces)):
            key.update(np.ascontiguousarray(part).tobytes())
        file = self._folder / f"{key.hexdigest()}.npz"
        if (kept := _read(file, p_WG, voxel_size)) is not None:
            return kept
        field = surfaces
        if not isinstance(field, Esdf):
            field = AnalyticDistanceField(field, lower_W, upper_W)
        esdf = esdf_from_distance_field(field, voxel_size).conservative()
        toa = time_of_arrival(esdf, p_WG)
        arrays = {name: getattr(esdf, name) for name in ("distances", "states", "lower_W")}
        with contextlib.suppress(OSError), written_atomically(file) as path:
            np.savez(path, times=toa.times, reachable=toa.reachable, **arrays)
        return esdf, toa

    def prune(self) -> None:
        """Removes the files that were not used for longest, beyond the limit."""
        with contextlib.suppress(OSError):
            files = [(file.stat(), file) for file in self._folder.glob("*.npz")]
            left = _LIMIT
            for status, file in sorted(files, key=lambda one: -one[0].st_mtime):
                left -= status.st_size
                if left < 0:
                    file.unlink(missing_ok=True)


def _content(surfaces: Sequence[Shape] | Esdf) -> list[np.ndarray | float | bytes]:
    if isinstance(surfaces, Esdf):
        return [surfaces.distances, surfaces.states, surfaces.lower_W, surfaces.voxel_size]
    return [
        part for shape in surfaces for part in (type(shape).__name__.encode(), *shape.parameters())
    ]


def _read(file: Path, p_WG: np.ndarray, voxel_size: float) -> tuple[Esdf, TimeOfArrival] | None:
    """Reads a file; returns None if it is missing or damaged."""
    try:
        kept = read_archive(file)
        os.utime(file)
        esdf = Esdf(
            kept["distances"], kept["states"], kept["lower_W"], voxel_size, occupied_outside=True
        )
        return esdf, TimeOfArrival(p_WG, kept["times"], kept["reachable"], esdf.lower_W, voxel_size)
    except (OSError, ValueError, KeyError):
        return None
