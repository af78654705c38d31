"""The worlds that policies train in: of the benchmark's kinds, of seeds that it never uses, and
captured places in which it never flies."""

from dataclasses import dataclass, field
from itertools import cycle
from typing import NamedTuple

import torch

from splatpilot.diagrams.worlds.make_world import make_world, place_config
from splatpilot.diagrams.worlds.start_and_goal import draw_start_and_goal
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.progress import Progress
from splatpilot.systems.seeds import SEEDS_PER_RUN, VALIDATION_SEEDS, first_training_seed
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.training.policies.world_batch import TrainingWorld, WorldBatch
from splatpilot.training.policies.world_cache import WorldCache
from splatpilot.training.world_kinds import (
    PROCEDURAL,
    ROUNDABOUT,
    check_generated,
    place_to_learn_in,
    world_of,
)

PLACE_MARGIN = 0.3
"""[m] that starts, goals and ways in captured places keep beyond the vehicle's radius; half of it
where no way has as much."""

PLACE_LONGEST = 25.0
"""[m], of the ways that are drawn there."""


@dataclass
class WorldSelection:
    """Which worlds, and how many."""

    # Scenarios whose generated worlds are trained in, the benchmark's or files, in turn; naming one
    # twice doubles its part.
    kinds: list[str] = field(default_factory=lambda: [*PROCEDURAL, *ROUNDABOUT])
    # Captured places, scene folders or OctoMaps, that take their turns after the kinds, each time
    # with another start and goal; those of held-out worlds differ too, their places do not.
    scenes: list[str] = field(default_factory=list)
    # [-] Worlds trained in.
    count: int = 180
    # [-] Held-out worlds that choose among checkpoints.
    held_out: int = 72
    # [m] Of the grids of the time of arrival, which are kept in the user's cache, up to 1 GiB.
    voxel_size: float = 0.25

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        if not self.turns:
            raise ValueError("worlds has neither kinds nor scenes; name some")
        for kind in self.kinds:
            check_generated(kind)
        for scene in self.scenes:
            place_to_learn_in(scene)
        for name in ("count", "held_out"):
            value = getattr(self, name)
            if not 1 <= value <= SEEDS_PER_RUN:
                raise ValueError(f"worlds.{name} is {value}; it must be 1 to {SEEDS_PER_RUN}")
        if not 0.05 <= self.voxel_size <= 0.5:
            raise ValueError(f"worlds.voxel_size is {self.voxel_size} m; it must be 0.05 to 0.5")

    @property
    def turns(self) -> list[str]:
        """Of what kind or place worlds are, in turn."""
        return [*self.kinds, *self.scenes]


def make_training_world(kind: str, seed: int, cache: WorldCache) -> TrainingWorld:
    """Makes the world of a scenario and seed as the benchmark flies it, without what cameras
    see."""
    return TrainingWorld(*cache.blueprint(world_of(kind), seed))


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
        esdf = make_world(place_config(place_to_learn_in(scene)), seed=0).esdf
        return cls(esdf, esdf.conservative())

    def world(self, seed: int) -> TrainingWorld:
        p_WS, p_WG, _ = draw_start_and_goal(
            self.esdf, VEHICLE_RADIUS, seed, PLACE_MARGIN, PLACE_LONGEST
        )
        return TrainingWorld(self.conservative, self.esdf.lower_W, self.esdf.upper_W, p_WS, p_WG)
