"""What policies train in: worlds, generated or captured, and the time of arrival at their goals."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import HalfSpace, Shape
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival
from splatpilot.systems.progress import Progress
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.training.policies.ray_casting import (
    Geometry,
    Grids,
    MixedGeometry,
    ShapeGeometry,
)
from splatpilot.training.policies.world_cache import WorldCache

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

    def way(self, p_WQ: Tensor, world: Tensor) -> Tensor:
        """The direction (N, 3) of the way to the goal at p_WQ (N, 3) [m] in `world` (N,).

        Down the gradient of the time of arrival; straight within a metre of the goal, and where
        there is none.
        """
        to_goal = self.p_WG[world] - p_WQ
        if self._times is None:
            return torch.nn.functional.normalize(to_goal, dim=1)
        _, uphill = self._times.interpolate(p_WQ, world)
        near = to_goal.square().sum(1, keepdim=True) < _NEAR_GOAL**2
        downhill = torch.where(near, to_goal, -uphill)
        return torch.nn.functional.normalize(downhill, dim=1)

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
