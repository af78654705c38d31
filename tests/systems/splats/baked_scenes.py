"""Scenes to bake, and the camera that sees them."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot import _native
from splatpilot.systems.splats.scene import GaussianScene

LEVELS = _native.simd_levels()
WIDTH, HEIGHT = 83, 61
K = np.array([[70.0, 0, 41.0], [0, 75.0, 30.0], [0, 0, 1]])
X_WC = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), np.array([0.4, -0.3, -3.0]))


def random_scene(count=1000, seed=0, sh_degree=3):
    rng = np.random.default_rng(seed)
    arrays = (
        1.5 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(size=(count, 3)) - 2.5),
        rng.uniform(0.01, 1.0, count),
        0.3 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3)),
    )
    return GaussianScene(*(a.astype(np.float32) for a in arrays))


def wall(axis: int, at: float, opacity: float = 0.99, reach: float = 30.0) -> GaussianScene:
    """An orange wall of Gaussians 0.5 m apart across an axis at a coordinate [m]."""
    steps = np.arange(-reach, reach + 0.1, 0.5)
    means = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    count = len(means)
    return GaussianScene.from_colors(
        means=np.insert(means, axis, at, axis=1),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.tile(np.where(np.arange(3) == axis, 1e-3, 0.5), (count, 1)),
        opacities=np.full(count, opacity),
        colors=np.tile([1.0, 0.5, 0.0], (count, 1)),
    )
