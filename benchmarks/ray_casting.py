"""Times native casting against casting in torch, alone and within whole steps of training.

    OMP_NUM_THREADS=1 python benchmarks/ray_casting.py

64 vehicles of DiffAero, one core. Ways are measured in turns, in processor time; the least of a few
repeats. A step of training is one step of one vehicle with its part of the forward and backward
pass and of the optimiser. "Beyond 1 cm" is the part of pixels whose depths differ by more: torch
looks at the 24 nearest shapes of each kind, native code at all, and rays that graze an edge may end
on either side of it.
"""

import time
from collections.abc import Callable
from copy import copy
from functools import partial

import numpy as np
import torch
from harness import header, machine, row
from torch import Tensor
from torch_geometry import TorchGeometry

from splatpilot.diagrams.worlds.world_registry import make_spec
from splatpilot.systems.common.seeds import first_training_seed
from splatpilot.training.corpus.library import world_of
from splatpilot.training.policies.evaluation import render_depth
from splatpilot.training.policies.ray_casting import Geometry
from splatpilot.training.policies.rollouts import NEAREST, DifferentiableRollout, RolloutConfig
from splatpilot.training.policies.train import step_optimizer
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.training_worlds import (
    WorldBatch,
    WorldSelection,
    training_worlds,
)

COUNT = 16
WORLDS = {"forests": ["P02", "P03"], "walls": ["P06", "P09"], "rooms": ["P04", "P05"]}


def in_turns(ways: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """The least processor time [s] of each way, after one run that does not count."""
    least = dict.fromkeys(ways, np.inf)
    for repeat in range(repeats + 1):
        for name, run in ways.items():
            started = time.process_time()
            run()
            if repeat > 0:
                least[name] = min(least[name], time.process_time() - started)
    return least


def with_torch(worlds: WorldBatch, kinds: list[str]) -> WorldBatch:
    """The same worlds with casting in torch."""
    plans = [
        make_spec(world_of(kinds[i % len(kinds)]), first_training_seed(0) + i) for i in range(COUNT)
    ]
    other = copy(worlds)
    other.geometry = TorchGeometry(
        [[solid.shape for solid in plan.solids] for plan in plans],
        np.array([plan.lower_W for plan in plans]),
        np.array([plan.upper_W for plan in plans]),
    )
    return other


def training_step(worlds: WorldBatch) -> tuple[DifferentiableRollout, Callable[[], object]]:
    torch.manual_seed(0)
    learner = DiffAeroLearner(DiffAeroLoss())
    rollout = DifferentiableRollout(
        learner, worlds, RolloutConfig(), torch.Generator().manual_seed(0)
    )
    optimizer = torch.optim.AdamW(learner.network.parameters())
    return rollout, lambda: step_optimizer(rollout.losses, learner.network, optimizer, 1.0)


def compare(name: str, kinds: list[str]) -> None:
    """Prints the rows of worlds of these kinds."""
    selection = WorldSelection(kinds=kinds, count=COUNT, voxel_size=0.4)
    native = training_worlds(selection, seed=0)
    worlds = {"native": native, "torch": with_torch(native, kinds)}
    training = {way: training_step(batch) for way, batch in worlds.items()}
    rollout = training["native"][0]
    vehicle, world, rays = rollout.episodes.vehicle, rollout.episodes.world, rollout.learner.rays

    def image(geometry: Geometry) -> Tensor:
        return render_depth(vehicle, geometry, rays, world).clamp(max=12.0)

    def nearest(geometry: Geometry) -> object:
        return geometry.nearest(vehicle.p, world, NEAREST)

    def each(query: Callable[[Geometry], object]) -> dict[str, float]:
        ways = {way: partial(query, batch.geometry) for way, batch in worlds.items()}
        return in_turns(ways, 20)

    apart = (image(worlds["native"].geometry) - image(worlds["torch"].geometry)).abs()
    rendering, measuring = each(image), each(nearest)
    learning = in_turns({way: step for way, (_, step) in training.items()}, 5)
    steps = rollout.config.environments * rollout.config.steps
    for way in worlds:
        row(
            name,
            way,
            f"{apart.numel() / rendering[way]:.2e}",
            f"{len(world) / measuring[way]:.2e}",
            f"{float((apart > 0.01).float().mean()):.2%}",
            f"{steps / learning[way]:.0f}",
        )


def main() -> None:
    torch.set_num_threads(1)
    print(machine())
    header("worlds", "casting", "rays/s", "distances/s", "beyond 1 cm", "steps of training/s")
    for name, kinds in WORLDS.items():
        compare(name, kinds)


if __name__ == "__main__":
    main()
