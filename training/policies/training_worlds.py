"""Worlds to train in: of the benchmark's kinds, by seeds that it does not use, and captured scenes
in which it does not fly."""

import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Memory
from pydrake.math import RigidTransform, RotationMatrix
from torch import Tensor

from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.feasibility import choose_start_and_goal
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import (
    WorldConfig,
    make_spec,
    make_world,
    scene_config,
)
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace, Shape
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import cache_folder, require_writable_folder
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import (
    SEEDS_PER_RUN,
    VALIDATION_SEEDS,
    first_training_seed,
    program,
)
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BatchRenderer
from splatpilot.systems.splats.splat_camera import color_pixels
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.corpus import library
from splatpilot.training.policies.ray_casting import Geometry, Grids, MixedGeometry, ShapeGeometry
from splatpilot.training.policies.vehicles import Vehicle, camera_poses

_LIMIT = 1 << 30  # [bytes] of the cache; the files that were used last stay.


class WorldCache:
    """Cache of training worlds and times of arrival, in the user's folder if it can be written."""

    def __init__(self) -> None:
        folder = cache_folder("worlds")
        try:
            require_writable_folder(folder)
        except OSError:
            folder = None
        self._memory, self._program = Memory(folder, verbose=0), program()

    def world(self, config: WorldConfig, seed: int) -> "TrainingWorld":
        """Makes the world of a configuration and seed, without its appearance."""
        make: Any = self._memory.cache(_make_world, ignore=["config"])
        return make(config, dump_config(config), seed, self._program)

    def arrival(self, world: "TrainingWorld", voxel_size: float) -> tuple[Esdf, TimeOfArrival]:
        """Returns conservative distances and times of arrival, on grids of `voxel_size` [m]."""
        surfaces, p_WG = world.surfaces, world.p_WG
        if isinstance(surfaces, Esdf):
            parts = [surfaces.distances, surfaces.states, surfaces.lower_W, surfaces.voxel_size]
        else:
            parts = [(type(shape).__name__, *shape.parameters()) for shape in surfaces]
        decisive = [world.lower_W, world.upper_W, p_WG, parts, self._program]
        find: Any = self._memory.cache(_find_arrival, ignore=["world"])
        distances, states, lower_W, times, reachable = find(world, voxel_size, decisive)
        grid = lower_W, voxel_size
        toa = TimeOfArrival(p_WG, times, reachable, *grid)
        return Esdf(distances, states, *grid, occupied_outside=True), toa

    def prune(self) -> None:
        """Removes the files that were used least recently, beyond the limit."""
        self._memory.reduce_size(bytes_limit=_LIMIT)


def _make_world(
    config: WorldConfig, text: str, seed: int, program: dict[str, str]
) -> "TrainingWorld":
    spec = make_spec(config, seed)
    shapes = [solid.shape for solid in spec.solids]
    return TrainingWorld(shapes, spec.lower_W, spec.upper_W, spec.p_WS, spec.p_WG)


def _find_arrival(
    world: "TrainingWorld", voxel_size: float, decisive: list[Any]
) -> tuple[np.ndarray, ...]:
    field = world.surfaces
    if not isinstance(field, Esdf):
        field = AnalyticDistanceField(field, world.lower_W, world.upper_W)
    esdf = esdf_from_distance_field(field, voxel_size).conservative()
    toa = time_of_arrival(esdf, world.p_WG)
    return esdf.distances, esdf.states, esdf.lower_W, toa.times, toa.reachable


STARTS = 256  # positions in each world from which flights of training start

_START_CLEARANCE = 0.3  # [m]
_NEAR_GOAL = 1.0  # [m], within which paths are straight


@dataclass(frozen=True, eq=False)
class TrainingWorld:
    """The surfaces, volume, start and goal of a world."""

    # Shapes, or the conservative distance field of a captured scene, which its worlds share.
    surfaces: Sequence[Shape] | Esdf
    lower_W: np.ndarray  # (3,) [m]
    upper_W: np.ndarray  # (3,) [m]
    p_WS: np.ndarray  # (3,) [m] start
    p_WG: np.ndarray  # (3,) [m] goal


class WorldBatch:
    """W worlds as tensors: surfaces, volumes, starts, goals, and the path to each goal by grids of
    the time of arrival with `voxel_size` [m]; None for evaluation, without grids."""

    def __init__(
        self,
        worlds: Sequence[TrainingWorld],
        voxel_size: float | None,
        device: torch.device | str = "cpu",
    ) -> None:
        def tensor(values: Any) -> Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.float32, device=device)

        lower_W = [world.lower_W for world in worlds]
        self.lower_W, self.upper_W = tensor(lower_W), tensor([world.upper_W for world in worlds])
        self.p_WS, self.p_WG = tensor([w.p_WS for w in worlds]), tensor([w.p_WG for w in worlds])
        self.views: Any = None  # of colors, see `WorldViews`
        self._surfaces = [world.surfaces for world in worlds]
        self.geometry: Geometry = MixedGeometry(self._surfaces)
        self._times = None
        if voxel_size is not None:
            cache = WorldCache()
            shown = Progress(worlds, "finding paths to the goals", unit="world")
            self.maps = [cache.arrival(world, voxel_size) for world in shown]
            cache.prune()
            sizes = [voxel_size] * len(worlds)
            self._distances = Grids([esdf.distances for esdf, _ in self.maps], lower_W, sizes)
            self._times = Grids([toa.times for _, toa in self.maps], lower_W, sizes)
            starts = []
            for seed, (esdf, toa) in enumerate(self.maps):
                free = toa.starts(esdf, _START_CLEARANCE)
                starts.append(free[np.random.default_rng(seed).integers(len(free), size=STARTS)])
            self.starts_W = tensor(starts)

    def __len__(self) -> int:
        return len(self.p_WG)

    def without_obstacles(self) -> "WorldBatch":
        """Returns the same worlds with nothing but ground, and straight paths."""
        empty = copy(self)
        grounds = [
            [HalfSpace([0.0, 0.0, 1.0], float(surfaces.lower_W[2]))]
            if isinstance(surfaces, Esdf)
            else [shape for shape in surfaces if isinstance(shape, HalfSpace)]
            for surfaces in self._surfaces
        ]
        empty.geometry = ShapeGeometry(grounds)
        empty._times = None
        return empty

    def direction(self, p_WQ: Tensor, world: Tensor) -> Tensor:
        """Computes directions (N, 3) at p_WQ (N, 3) [m] down the time of arrival; straight near the
        goal and without a gradient."""
        to_goal = self.p_WG[world] - p_WQ
        if self._times is None:
            return torch.nn.functional.normalize(to_goal, dim=1)
        _, uphill = self._times.interpolate(p_WQ, world)
        near = to_goal.square().sum(1, keepdim=True) < _NEAR_GOAL**2
        downhill = torch.where(near, to_goal, -uphill)
        return torch.nn.functional.normalize(downhill, dim=1)

    def clearance(self, p_WQ: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
        """Computes clearances (N,) [m] at p_WQ (N, 3) [m], and whether it is in the volume (N,)."""
        distances, _ = self.geometry.nearest(p_WQ, world, 1)
        inside = (p_WQ > self.lower_W[world]) & (p_WQ < self.upper_W[world])
        return distances[:, 0] - VEHICLE_RADIUS, inside.all(1)

    def ended(self, p_WB: Tensor, world: Tensor) -> Tensor:
        """Tells which vehicles (N,) are in contact, outside the volume or 0.5 m from the goal."""
        clearance, inside = self.clearance(p_WB, world)
        return (clearance < 0.0) | ~inside | ((p_WB - self.p_WG[world]).norm(dim=1) < 0.5)

    def color(self, vehicle: Vehicle, world: Tensor) -> Tensor | None:
        """Renders colors (N, H, W, 3) by the `views`, if there are any."""
        return None if self.views is None else self.views.render(vehicle, world)

    def distance(self, p_WQ: Tensor, world: Tensor) -> Tensor:
        """Interpolates distances (N,) [m] at p_WQ (N, 3) [m] to surfaces and the volume's faces."""
        return self._distances.interpolate(p_WQ, world)[0]


# Of starts, goals and paths in captured scenes.
_SCENE_MARGIN = 0.3  # [m] clearance beyond the vehicle's radius; half of it if no path has as much
_MAX_SCENE_PATH = 25.0  # [m]


@dataclass
class WorldSelection(Config):
    """Selection of training worlds."""

    # Scenarios whose generated worlds take turns, the benchmark's or files; naming one twice
    # doubles its share.
    kinds: list[str] = field(default_factory=lambda: [*library.PROCEDURAL, *library.ROUNDABOUT])
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
        library.check_library(self.kinds, self.scenes)
        for scene in self.scenes:
            library.training_scene(scene)

    def digest(self) -> str:
        """Computes a digest of the files of kinds and scenes."""
        files = [scenario_file(kind) for kind in self.kinds]
        for scene in map(library.training_scene, self.scenes):
            files += sorted(filter(Path.is_file, scene.iterdir())) if scene.is_dir() else [scene]
        made_later = "metrics.json", "views.png"
        digest = blake2b(digest_size=16)
        for file in files:
            if file.name not in made_later:
                digest.update(file.read_bytes())
        return digest.hexdigest()

    @property
    def turns(self) -> list[str]:
        """Kinds and scenes in the order in which they take turns."""
        return [*self.kinds, *self.scenes]


def training_worlds(
    selection: WorldSelection, seed: int, device: torch.device | str = "cpu"
) -> WorldBatch:
    """Makes the training worlds of a run of `seed`, 0 to 999; those of two seeds differ."""
    first = first_training_seed(seed)
    worlds = _make_worlds(selection, selection.count, first, "training worlds")
    return WorldBatch(worlds, selection.voxel_size, device)


def validation_worlds(selection: WorldSelection, device: torch.device | str = "cpu") -> WorldBatch:
    """Makes the held-out worlds, the same for every run."""
    worlds = _make_worlds(selection, selection.held_out, VALIDATION_SEEDS, "held-out worlds")
    return WorldBatch(worlds, None, device)


def _world_turns(selection: WorldSelection, count: int, first: int) -> list[tuple[int, str]]:
    """Lists the seed, from `first` on, and the kind or scene of each of `count` worlds."""
    return list(zip(range(first, first + count), cycle(selection.turns), strict=False))


def _captured_world(scene: str) -> World:
    return make_world(scene_config(library.training_scene(scene)), seed=0)


def _make_worlds(
    selection: WorldSelection, count: int, first: int, what: str
) -> list[TrainingWorld]:
    scenes = {}
    for scene in selection.scenes:  # One at a time: their Gaussians need memory.
        esdf = _captured_world(scene).esdf
        scenes[scene] = esdf, esdf.conservative()
    cache, worlds = WorldCache(), []
    turns = _world_turns(selection, count, first)
    for seed, turn in Progress(turns, f"making {what}", unit="world"):
        if turn not in scenes:
            worlds.append(cache.world(library.scenario_world(turn), seed))
            continue
        esdf, conservative = scenes[turn]
        p_WS, p_WG, _ = choose_start_and_goal(esdf, _SCENE_MARGIN, _MAX_SCENE_PATH, seed=seed)
        worlds.append(TrainingWorld(conservative, esdf.lower_W, esdf.upper_W, p_WS, p_WG))
    return worlds


class WorldViews:
    """Renders the worlds of a `WorldBatch`, `count` from the seed `first`, from vehicles' cameras.
    The camera's `merged_spread` may be larger than in flight."""

    def __init__(
        self, selection: WorldSelection, count: int, first: int, camera: OnboardCamera
    ) -> None:
        scenes = {scene: _captured_world(scene) for scene in selection.scenes}
        turns = Progress(_world_turns(selection, count, first), "rendering worlds", unit="world")
        self._worlds = [
            scenes.get(turn) or make_world(library.scenario_world(turn), seed)
            for seed, turn in turns
        ]
        self._seen = list(self._worlds)
        # (W, 2), seed and strength of each appearance; a strength of 0 is the world's own.
        self.looks = torch.zeros(count, 2, dtype=torch.float64)
        self._camera, self._renderer = camera, BatchRenderer(os.cpu_count() or 1)

    def repaint(self, strength: float, generator: torch.Generator) -> None:
        """Gives a random world another appearance, of a strength up to `strength`."""
        drawn = torch.rand(3, generator=generator, dtype=torch.float64, device=generator.device)
        world, seed, part = drawn.tolist()
        index = int(world * len(self._worlds))
        self.looks[index, 0], self.looks[index, 1] = int(seed * 2**31), part * strength
        self._paint(index)

    def restore(self, looks: Tensor) -> None:
        """Restores the appearances `looks`."""
        self.looks = looks
        for index in looks[:, 1].nonzero()[:, 0].tolist():
            self._paint(index)

    def _paint(self, index: int) -> None:
        seed, strength = self.looks[index].tolist()
        self._seen[index] = randomize_appearance(self._worlds[index], strength, int(seed))

    @torch.no_grad()
    def render(self, vehicle: Vehicle, world: Tensor) -> Tensor:
        """Renders colors (N, H, W, 3), uint8, from the vehicles' cameras in `world` (N,)."""
        poses = (part.double().cpu().numpy() for part in camera_poses(vehicle))
        X_WCs = [
            RigidTransform(RotationMatrix.ProjectToRotationMatrix(R_WC), p_WC)
            for p_WC, R_WC in zip(*poses, strict=True)
        ]
        worlds = [self._seen[index] for index in world.tolist()]
        info = self._camera.camera_info()
        color = self._renderer.render_color(
            [world.baked for world in worlds],
            info.intrinsic_matrix(),
            info.width(),
            info.height(),
            X_WCs,
            backgrounds=[world.background for world in worlds],
            merged_spread=self._camera.merged_spread,
        )
        return torch.from_numpy(color_pixels(color)).to(world.device)
