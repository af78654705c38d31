"""How fast policies learn and fly: steps per second of one core, and what a tick costs in flight.

    OMP_NUM_THREADS=1 python benchmarks/training.py

Times are processor time, the least of a few repeats.
"""

import numpy as np
import torch
from harness import seconds

from splatpilot.systems.policies.base import Observation
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, decide, depth_grid
from splatpilot.systems.policies.recurrent_network import RecurrentNetwork
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.policies.evaluation import render_depth
from splatpilot.training.policies.rollouts import DifferentiableRollout, RolloutConfig
from splatpilot.training.policies.train import step_optimizer
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.training_worlds import WorldSelection, training_worlds


def main() -> None:
    torch.set_num_threads(1)
    print(f"{'worlds':<12}{'learning':>12}{'flying':>12}{'rendering':>12}{'its part':>10}")
    for kinds in (["P02", "P03"], ["P06", "P09"], ["P04", "P05"]):
        selection = WorldSelection(kinds=kinds, count=16, voxel_size=0.4)
        worlds = training_worlds(selection, seed=0)
        learner = DiffAeroLearner(DiffAeroLoss())
        rollout = DifferentiableRollout(
            learner, worlds, RolloutConfig(), torch.Generator().manual_seed(0)
        )
        optimizer = torch.optim.AdamW(learner.network.parameters())
        steps = rollout.config.environments * rollout.config.steps

        def learn(rollout=rollout, learner=learner, optimizer=optimizer) -> None:
            step_optimizer(rollout.losses, learner.network, optimizer, 1.0)

        def render(rollout=rollout, learner=learner, worlds=worlds) -> None:
            episodes = rollout.episodes
            render_depth(episodes.vehicle, worlds.geometry, learner.rays, episodes.world)

        learning = seconds(learn, 4)
        with torch.no_grad():
            flying = seconds(rollout.losses, 4)
        rendering = seconds(render, 20) * rollout.config.steps
        row = "".join(f"{steps / s:>10.0f}/s" for s in (learning, flying, rendering))
        print(f"{'+'.join(kinds):<12}{row}{rendering / learning:>10.0%}")

    rng = np.random.default_rng(0)
    network = RecurrentNetwork(
        DIFFAERO_NETWORK,
        {name: rng.normal(size=s) for name, s in DIFFAERO_NETWORK.weight_shapes().items()},
    )
    state, depth = hover_state([0, 0, 2]), rng.uniform(0.5, 15.0, (36, 64))
    memory, p_WG = network.initial_hidden(), np.array([9.0, 0.0, 2.0])
    seen = Observation(0.0, pose_from_state(state), QuadrotorState.of(state), p_WG, depth)

    def tick() -> None:
        for _ in range(100):
            decide(network, depth_grid(seen.image), seen, 2.0, memory)

    print(f"one tick of diffaero in flight: {10.0 * seconds(tick, 5):.3f} ms")


if __name__ == "__main__":
    main()
