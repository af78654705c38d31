import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.training.corpus.library import PerturbationConfig, perturb_pose

X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 2.0), np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize(("distance", "reach"), [(0.3, 1.0), (0.5, 0.2), (0.5, -0.1)])
def test_displacements_fill_the_smaller_ball(distance, reach):
    config = PerturbationConfig(distance=distance, yaw=0.0, tilt=0.0)
    rng = np.random.default_rng(0)
    poses = [perturb_pose(X_WB, config, reach, rng) for _ in range(2000)]
    radius = max(0.0, min(distance, reach))
    offsets = np.array([X.translation() - X_WB.translation() for X in poses])
    lengths = np.linalg.norm(offsets, axis=1)
    assert lengths.max() <= radius + 1e-12
    if radius:
        assert np.mean(lengths < radius * 0.5 ** (1 / 3)) == pytest.approx(0.5, abs=0.04)
        np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=0.04 * radius)
    for X in poses[:3]:
        np.testing.assert_allclose(X.rotation().matrix(), X_WB.rotation().matrix(), atol=1e-12)


def test_yaw_turns_about_the_vertical():
    config = PerturbationConfig(yaw=0.4, tilt=0.0)
    rng = np.random.default_rng(1)
    turns = []
    for _ in range(200):
        R = perturb_pose(X_WB, config, 1.0, rng).rotation() @ X_WB.rotation().inverse()
        np.testing.assert_allclose(R.matrix() @ [0, 0, 1], [0, 0, 1], atol=1e-12)
        turns.append(R.ToAngleAxis().angle())
    assert 0.35 < max(turns) <= 0.4 + 1e-12


def test_tilt_keeps_its_limit():
    config = PerturbationConfig(yaw=0.0, tilt=0.1)
    rng = np.random.default_rng(2)
    z = [perturb_pose(X_WB, config, 1.0, rng).rotation().matrix()[:, 2] for _ in range(200)]
    leans = np.arccos(np.clip(np.array(z) @ X_WB.rotation().matrix()[:, 2], -1, 1))
    assert 0.08 < leans.max() <= 0.1 * np.sqrt(2) + 1e-9
