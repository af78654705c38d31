"""The worlds that policies train in: of the benchmark's kinds, of seeds that it never uses."""

from dataclasses import dataclass, field

import torch

from splatpilot.diagrams.worlds.make_world import make_blueprint
from splatpilot.systems.seeds import SEEDS_PER_RUN, VALIDATION_SEEDS, first_training_seed
from splatpilot.training.policies.world_batch import TrainingWorld, WorldBatch
from splatpilot.training.world_kinds import PROCEDURAL, ROUNDABOUT, world_of


@dataclass
class WorldSelection:
    """Which worlds, and how many."""

    # Scenarios whose worlds are trained in, in turn; naming one twice doubles its part.
    kinds: list[str] = field(default_factory=lambda: [*PROCEDURAL, *ROUNDABOUT])
    # [-] Worlds trained in.
    count: int = 180
    # [-] Held-out worlds that choose among checkpoints.
    held_out: int = 72
    # [m] Of the grids of the time of arrival.
    voxel_size: float = 0.25

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        unknown = [kind for kind in self.kinds if kind not in PROCEDURAL]
        if unknown or not self.kinds:
            raise ValueError(f"worlds.kinds is {self.kinds}; choose from {', '.join(PROCEDURAL)}")
        for name in ("count", "held_out"):
            value = getattr(self, name)
            if not 1 <= value <= SEEDS_PER_RUN:
                raise ValueError(f"worlds.{name} is {value}; it must be 1 to {SEEDS_PER_RUN}")
        if not 0.05 <= self.voxel_size <= 0.5:
            raise ValueError(f"worlds.voxel_size is {self.voxel_size} m; it must be 0.05 to 0.5")


def make_training_world(kind: str, seed: int) -> TrainingWorld:
    """The world of a scenario and seed as the benchmark flies it, without what cameras see."""
    plan = make_blueprint(world_of(kind), seed)
    shapes = [solid.shape for solid in plan.solids]
    return TrainingWorld(shapes, plan.lower_W, plan.upper_W, plan.p_WS, plan.p_WG)


def training_worlds(
    selection: WorldSelection, seed: int, device: torch.device | str = "cpu"
) -> WorldBatch:
    """The worlds that a training run of `seed` learns in; those of different seeds differ.

    Raises:
        ValueError: if the seed is not 0 to 999.
    """
    worlds = _make_worlds(selection, selection.count, first_training_seed(seed))
    return WorldBatch(worlds, selection.voxel_size, device)


def validation_worlds(selection: WorldSelection, device: torch.device | str = "cpu") -> WorldBatch:
    """The held-out worlds, the same for every run."""
    return WorldBatch(_make_worlds(selection, selection.held_out, VALIDATION_SEEDS), None, device)


def _make_worlds(selection: WorldSelection, count: int, first: int) -> list[TrainingWorld]:
    kinds = selection.kinds
    return [make_training_world(kinds[i % len(kinds)], first + i) for i in range(count)]
