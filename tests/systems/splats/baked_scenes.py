"""Scenes to bake, and the camera that sees them."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot import _native
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.splats.moving_bodies import MovingObstacles
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


def uniform_scene(means, scale, opacity=0.99, color=(0.5, 0.5, 0.5), quat=(1.0, 0, 0, 0)):
    """Gaussians that differ in their means (N, 3) and perhaps colors (N, 3) alone."""
    rows = (
        np.broadcast_to(value, (len(means), np.shape(value)[-1])) for value in (quat, scale, color)
    )
    quats, scales, colors = rows
    return GaussianScene.from_colors(means, quats, scales, np.full(len(means), opacity), colors)


def wall(axis: int, at: float, opacity: float = 0.99, reach: float = 30.0) -> GaussianScene:
    """An orange wall of Gaussians 0.5 m apart across an axis at a coordinate [m]."""
    steps = np.arange(-reach, reach + 0.1, 0.5)
    means = np.insert(np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2), axis, at, axis=1)
    return uniform_scene(means, np.where(np.arange(3) == axis, 1e-3, 0.5), opacity, (1.0, 0.5, 0.0))


def moving(gaussians: GaussianScene, path, period: float = 1.0, radius=0.5) -> MovingObstacles:
    """An obstacle of Gaussians about its center that follows a path (n, 3) [m], a row a period."""
    return MovingObstacles(MovingSpheres([radius], [np.array(path)], period), [gaussians])


def plane(X_WP: RigidTransform, half: float, step: float) -> GaussianScene:
    """A gray square of flat Gaussians at z = 0 of frame P."""
    x, y = (axis.ravel() for axis in np.mgrid[-half:half:step, -half:half:step] + step / 2)
    means = X_WP.multiply(np.stack([x, y, 0 * x])).T
    quat = X_WP.rotation().ToQuaternion().wxyz()
    return uniform_scene(means, [0.7 * step, 0.7 * step, 1e-4], quat=quat)


def plane_depth(X_CP: RigidTransform, slopes: np.ndarray) -> np.ndarray:
    """The depth (H, W) [m] of the plane z = 0 of P along rays of these slopes (H, W, 2)."""
    n = X_CP.rotation().matrix()[:, 2]
    return n @ X_CP.translation() / (slopes @ n[:2] + n[2])
