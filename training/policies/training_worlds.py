"""The worlds that policies train in: of the benchmark's kinds, of seeds that it never uses, and
captured places in which it never flies."""

import contextlib
import json
import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from hashlib import blake2b
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from pydrake.math import RigidTransform
from torch import Tensor

from splatpilot.diagrams.worlds.feasibility import draw_start_and_goal
from splatpilot.diagrams.worlds.world_registry import (
    WorldConfig,
    make_spec,
    make_world,
    scene_config,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Shape,
    Sphere,
)
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import (
    cache_folder,
    require_writable_folder,
    written_atomically,
)
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import program
from splatpilot.systems.common.readers import read_archive
from splatpilot.systems.common.seeds import SEEDS_PER_RUN, VALIDATION_SEEDS, first_training_seed
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.corpus.library import (
    PROCEDURAL,
    ROUNDABOUT,
    check_library,
    place_to_learn_in,
    world_of,
)
from splatpilot.training.policies.ray_casting import Geometry, Grids, MixedGeometry, ShapeGeometry

# Training worlds and the times of arrival in them, kept in the user's cache: making them again
# would delay every start and every resumption of a training run.


_LIMIT = 1 << 30
"""[bytes] that files of the cache may take; those that were used last stay."""

_SHAPES = {shape.__name__: shape for shape in (Sphere, Capsule, Cylinder, Box, HalfSpace)}
"""Shapes that can be kept."""

_POINTS = "lower_W", "upper_W", "p_WS", "p_WG"
"""Of a `WorldSpec`, each (3,) [m]."""

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

    def spec(self, config: WorldConfig, seed: int) -> ShapesAndPoints:
        """Returns the shapes of a generated world, and its `lower_W`, `upper_W`, `p_WS` and `p_WG`.

        Raises:
            ValueError: see `make_spec`.
        """
        file = self._file("json", f"{dump_config(config)}{seed}".encode())
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            kept = json.loads(file.read_text())
            os.utime(file)
            return [_shape(one) for one in kept["shapes"]], *(np.array(kept[p]) for p in _POINTS)
        plan = make_spec(config, seed)
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


STARTS = 256
"""Places that flights of training start from, in each world."""

_START_CLEARANCE = 0.3  # [m]
_NEAR_GOAL = 1.0  # [m], within which the way is straight


@dataclass(frozen=True, eq=False)
class TrainingWorld:
    """One world: what stands in its volume, and where to fly."""

    # Its shapes, or of a captured place the distance field in which all that is unknown counts as
    # occupied (`Esdf.conservative`); worlds of the same place share it.
    surfaces: Sequence[Shape] | Esdf
    lower_W: np.ndarray  # (3,) [m]
    upper_W: np.ndarray  # (3,) [m]
    p_WS: np.ndarray  # (3,) [m] start
    p_WG: np.ndarray  # (3,) [m] goal


class WorldBatch:
    """W worlds as tensors: surfaces, volumes, starts, goals, and the way to each goal.

    Args:
      worlds: W of them.
      voxel_size: [m] of the grids of the time of arrival; None for none of them, which evaluation
        does not need.
      device: where the tensors live.
    """

    def __init__(
        self,
        worlds: Sequence[TrainingWorld],
        voxel_size: float | None,
        device: torch.device | str = "cpu",
    ) -> None:
        def tensor(values: Any) -> Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.float32, device=device)

        self.lower_W, self.upper_W = (
            tensor([getattr(world, name) for world in worlds]) for name in ("lower_W", "upper_W")
        )
        self.p_WS, self.p_WG = (
            tensor([getattr(world, name) for world in worlds]) for name in ("p_WS", "p_WG")
        )
        self._surfaces = [world.surfaces for world in worlds]
        self.geometry: Geometry = MixedGeometry(self._surfaces)
        self._times = None
        if voxel_size is not None:
            cache = WorldCache()
            shown = Progress(worlds, "finding paths to the goals", unit="world")
            grids = [_march(world, voxel_size, n, cache) for n, world in enumerate(shown)]
            cache.prune()
            self.maps = [(grid.esdf, grid.toa) for grid in grids]

            def on_grids(values: list[np.ndarray]) -> Grids:
                lower_W = [world.lower_W for world in worlds]
                return Grids(values, lower_W, [voxel_size] * len(worlds))

            self._distances = on_grids([grid.esdf.distances for grid in grids])
            self._times = on_grids([grid.toa.times for grid in grids])
            self.starts_W = tensor([grid.starts_W for grid in grids])  # (W, STARTS, 3) [m]

    def __len__(self) -> int:
        return len(self.p_WG)

    def without_obstacles(self) -> "WorldBatch":
        """The same volumes, starts and goals with nothing but ground, and straight ways."""
        empty = copy(self)
        empty.geometry = ShapeGeometry([_ground(surfaces) for surfaces in self._surfaces])
        empty._times = None
        return empty

    def direction(self, p_WQ: Tensor, world: Tensor) -> Tensor:
        """Computes directions (N, 3) of the paths to the goals at p_WQ (N, 3) [m] in `world` (N,).

        They are down the gradient of the time of arrival, and straight within a meter of the goal
        and where there is no gradient.
        """
        to_goal = self.p_WG[world] - p_WQ
        if self._times is None:
            return torch.nn.functional.normalize(to_goal, dim=1)
        _, uphill = self._times.interpolate(p_WQ, world)
        near = to_goal.square().sum(1, keepdim=True) < _NEAR_GOAL**2
        downhill = torch.where(near, to_goal, -uphill)
        return torch.nn.functional.normalize(downhill, dim=1)

    def clearance(self, p_WQ: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
        """Computes distances (N,) [m] of vehicles at p_WQ (N, 3) [m] in `world` (N,) to the nearest
        obstacle beyond their radius, and whether they are inside the volume (N,)."""
        distances, _ = self.geometry.nearest(p_WQ, world, 1)
        inside = (p_WQ > self.lower_W[world]) & (p_WQ < self.upper_W[world])
        return distances[:, 0] - VEHICLE_RADIUS, inside.all(1)

    def distance(self, p_WQ: Tensor, world: Tensor) -> Tensor:
        """Signed distance (N,) [m] at p_WQ (N, 3) [m] in `world` (N,), from the grid: the bounds of
        the volume count as surfaces, and it costs the same however many shapes there are."""
        return self._distances.interpolate(p_WQ, world)[0]


def _ground(surfaces: Sequence[Shape] | Esdf) -> list[Shape]:
    if isinstance(surfaces, Esdf):
        return [HalfSpace([0.0, 0.0, 1.0], float(surfaces.lower_W[2]))]
    return [shape for shape in surfaces if isinstance(shape, HalfSpace)]


class _Arrival(NamedTuple):
    esdf: Esdf  # conservative
    toa: TimeOfArrival
    starts_W: np.ndarray  # (STARTS, 3) [m]


def _march(world: TrainingWorld, voxel_size: float, seed: int, cache: WorldCache) -> _Arrival:
    """The time of arrival at the goal of a world, and free places from which it can be reached."""
    volume = world.lower_W, world.upper_W
    esdf, toa = cache.arrival(world.surfaces, *volume, world.p_WG, voxel_size)
    roomy = toa.reachable & (esdf.distances > VEHICLE_RADIUS + _START_CLEARANCE)
    cells = np.argwhere(roomy)
    if len(cells) == 0:
        raise ValueError("no place in the world has room to start from; make it less dense")
    rng = np.random.default_rng(seed)
    starts = cells[rng.integers(len(cells), size=STARTS)] + 0.5
    return _Arrival(esdf, toa, world.lower_W + voxel_size * starts)


PLACE_MARGIN = 0.3
"""[m] that starts, goals and ways in captured places keep beyond the vehicle's radius; half of it
where no way has as much."""

PLACE_LONGEST = 25.0
"""[m], of the ways that are drawn there."""


@dataclass
class WorldSelection(Config):
    """Selection of training worlds."""

    # Scenarios whose generated worlds take turns, the benchmark's or files; naming one twice
    # doubles its share.
    kinds: list[str] = field(default_factory=lambda: [*PROCEDURAL, *ROUNDABOUT])
    # Scene folders or OctoMaps that take turns after the kinds, each time with another start and
    # goal; also in held-out worlds.
    scenes: list[str] = field(default_factory=list)
    # [-] Number of training worlds.
    count: int = bounded(180, f"[1, {SEEDS_PER_RUN}]")
    # [-] Number of held-out worlds, which select among checkpoints.
    held_out: int = bounded(72, f"[1, {SEEDS_PER_RUN}]")
    # [m] Voxel size of the time of arrival, which is kept in the user's cache, up to 1 GiB.
    voxel_size: float = bounded(0.25, "[0.05, 0.5] m")

    def check(self) -> None:
        check_library(self.kinds, self.scenes)
        for scene in self.scenes:
            place_to_learn_in(scene)

    @property
    def turns(self) -> list[str]:
        """Of what kind or place worlds are, in turn."""
        return [*self.kinds, *self.scenes]


def make_training_world(kind: str, seed: int, cache: WorldCache) -> TrainingWorld:
    """Makes the world of a scenario and seed as the benchmark flies it, without what cameras
    see."""
    return TrainingWorld(*cache.spec(world_of(kind), seed))


def training_worlds(
    selection: WorldSelection, seed: int, device: torch.device | str = "cpu"
) -> WorldBatch:
    """The worlds that a training run of `seed` learns in; those of different seeds differ.

    Raises:
        ValueError: if the seed is not 0 to 999.
    """
    first = first_training_seed(seed)
    worlds = _make_worlds(selection, selection.count, first, "training worlds")
    return WorldBatch(worlds, selection.voxel_size, device)


def validation_worlds(selection: WorldSelection, device: torch.device | str = "cpu") -> WorldBatch:
    """The held-out worlds, the same for every run."""
    worlds = _make_worlds(selection, selection.held_out, VALIDATION_SEEDS, "held-out worlds")
    return WorldBatch(worlds, None, device)


def _make_worlds(
    selection: WorldSelection, count: int, first: int, what: str
) -> list[TrainingWorld]:
    places = {scene: _Place.read(scene) for scene in selection.scenes}
    seeds = Progress(range(first, first + count), f"making {what}", unit="world")
    cache = WorldCache()
    return [
        places[turn].world(seed) if turn in places else make_training_world(turn, seed, cache)
        for seed, turn in zip(seeds, cycle(selection.turns), strict=False)
    ]


class _Place(NamedTuple):
    """A captured place, which its worlds share."""

    esdf: Esdf
    conservative: Esdf

    @classmethod
    def read(cls, scene: str) -> "_Place":
        esdf = make_world(scene_config(place_to_learn_in(scene)), seed=0).esdf
        return cls(esdf, esdf.conservative())

    def world(self, seed: int) -> TrainingWorld:
        p_WS, p_WG, _ = draw_start_and_goal(
            self.esdf, VEHICLE_RADIUS, seed, PLACE_MARGIN, PLACE_LONGEST
        )
        return TrainingWorld(self.conservative, self.esdf.lower_W, self.esdf.upper_W, p_WS, p_WG)
