"""Training worlds and the times of arrival in them, kept in the user's cache: making them again
would delay every start and every resumption of a training run."""

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import fields
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.make_world import WorldConfig, make_blueprint
from splatpilot.systems.array_files import read_archive
from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_from_distance_field import esdf_from_distance_field
from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.environment import cache_folder
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.provenance import program

_LIMIT = 1 << 30
"""[bytes] that files of the cache may take; those that were used last stay."""

_SHAPES = {shape.__name__: shape for shape in (Sphere, Capsule, Cylinder, Box, HalfSpace)}
"""Shapes that can be kept."""

_POINTS = "lower_W", "upper_W", "p_WS", "p_WG"
"""Of a `Blueprint`, each (3,) [m]."""

ShapesAndPoints = tuple[list[Shape], *tuple[np.ndarray, ...]]


class WorldCache:
    """Makes, or reads again, what training needs of worlds.

    What this program would make is the same to the last bit. Where the cache cannot be written
    nothing is kept.
    """

    def __init__(self) -> None:
        self._folder = cache_folder("worlds")
        self._program = repr(program()).encode()
        with contextlib.suppress(OSError):
            require_writable_folder(self._folder)

    def blueprint(self, config: WorldConfig, seed: int) -> ShapesAndPoints:
        """Returns the shapes of a generated world, and its `lower_W`, `upper_W`, `p_WS` and `p_WG`.

        Raises:
            ValueError: see `make_blueprint`.
        """
        file = self._file("json", f"{dump_config(config)}{seed}".encode())
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            kept = json.loads(file.read_text())
            os.utime(file)
            return [_shape(one) for one in kept["shapes"]], *(np.array(kept[p]) for p in _POINTS)
        plan = make_blueprint(config, seed)
        shapes = [solid.shape for solid in plan.solids]
        if all(type(shape) in _SHAPES.values() for shape in shapes):
            content = {"shapes": [_described(shape) for shape in shapes]}
            content |= {name: getattr(plan, name).tolist() for name in _POINTS}
            with contextlib.suppress(OSError), written_atomically(file) as path:
                path.write_text(json.dumps(content))
        return shapes, *(getattr(plan, name) for name in _POINTS)

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
        parts = lower_W, upper_W, p_WG, voxel_size, *_content(surfaces)
        file = self._file("npz", *(np.ascontiguousarray(part).tobytes() for part in parts))
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
            files = [(file.stat(), file) for file in self._folder.glob("[!.]*")]
            left = _LIMIT
            for status, file in sorted(files, key=lambda one: -one[0].st_mtime):
                left -= status.st_size
                if left < 0:
                    file.unlink(missing_ok=True)

    def _file(self, suffix: str, *decisive: bytes) -> Path:
        key = blake2b(self._program, digest_size=16)
        for part in decisive:
            key.update(part)
        return self._folder / f"{key.hexdigest()}.{suffix}"


def _described(shape: Shape) -> tuple[str, dict[str, Any]]:
    values = {field.name: getattr(shape, field.name) for field in fields(shape)}  # type: ignore
    return type(shape).__name__, {
        name: (v.GetAsMatrix34() if isinstance(v, RigidTransform) else np.asarray(v)).tolist()
        for name, v in values.items()
    }


def _shape(described: tuple[str, dict[str, Any]]) -> Shape:
    name, values = described
    if "X_WO" in values:
        values["X_WO"] = RigidTransform(np.array(values["X_WO"]))
    return _SHAPES[name](**values)


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
