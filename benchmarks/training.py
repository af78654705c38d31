"""Times how fast DiffAero trains on one core.

    OMP_NUM_THREADS=1 python benchmarks/training.py

Rays are those of the depth images; a step is forward, backward and optimizer of one vehicle.
"""

import torch
from harness import header, machine, milliseconds, row

from splatpilot.training.policies.evaluation import render_depth
from splatpilot.training.policies.rollouts import DifferentiableRollout, RolloutConfig
from splatpilot.training.policies.train import step_optimizer
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.training_worlds import WorldSelection, training_worlds


def print_row(kinds: list[str]) -> None:
    worlds = training_worlds(WorldSelection(kinds=kinds, count=16, voxel_size=0.4), seed=0)
    learner = DiffAeroLearner(DiffAeroLoss())
    generator = torch.Generator().manual_seed(0)
    rollout = DifferentiableRollout(learner, worlds, RolloutConfig(), generator)
    optimizer = torch.optim.AdamW(learner.network.parameters())
    environments, episodes = rollout.config.environments, rollout.episodes
    learning = milliseconds(
        lambda: step_optimizer(rollout.losses, learner.network, optimizer, 1.0), 4
    )
    rendering = milliseconds(
        lambda: render_depth(episodes.vehicle, worlds.geometry, learner.rays, episodes.world), 20
    )
    rays = 1e3 * environments * len(learner.rays.directions_C) / rendering
    steps = 1e3 * environments * rollout.config.steps / learning
    row(", ".join(kinds), f"{1e-6 * rays:.1f} M", f"{steps:.0f}")


def main() -> None:
    torch.set_num_threads(1)
    print(machine())
    header("worlds", "rays/s", "steps of training/s")
    for kinds in (["P02", "P03"], ["P06", "P09"], ["P04", "P05"]):
        print_row(kinds)


if __name__ == "__main__":
    main()
