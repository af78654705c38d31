"""Rollouts that a loss is differentiated through."""

import torch

from splatpilot.training.policies.rollouts import DifferentiableRollout, RolloutConfig
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.training_worlds import WorldSelection, training_worlds


def test_gradients_are_finite_where_obstacles_are_missing():
    """Over nothing but ground, where all obstacles but one are infinitely far, learning goes on."""
    worlds = training_worlds(WorldSelection(kinds=["P02"], count=1, voxel_size=0.5), seed=0)
    learner = DiffAeroLearner(DiffAeroLoss())
    rollout = DifferentiableRollout(
        learner,
        worlds.without_obstacles(),
        RolloutConfig(environments=8, steps=6),
        torch.Generator().manual_seed(0),
    )
    terms = rollout.losses()
    torch.stack(list(terms.values())).sum().backward()
    assert all(term.isfinite() for term in terms.values())
    gradients = [weight.grad for weight in learner.network.parameters()]
    assert all(g is not None and g.isfinite().all() and g.any() for g in gradients)
