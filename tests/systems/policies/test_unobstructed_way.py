"""The way where nothing stands in it, against the planner's in an empty place."""

import numpy as np
import pytest
import torch
from pydrake.math import RollPitchYaw

from splatpilot.systems.policies.lattice import (
    BASIS,
    LatticeConfig,
    TrajectoryLattice,
    unobstructed_way,
)
from splatpilot.systems.policies.motion_primitives import level_acceleration
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams


class _Open:
    """The time of arrival where nothing stands: a second for each metre."""

    def __init__(self, p_WG: np.ndarray) -> None:
        self.p_WG = p_WG

    def value(self, p_W: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p_W - self.p_WG, axis=-1)

    def gradient(self, p_W: np.ndarray) -> np.ndarray:
        return (p_W - self.p_WG) / self.value(p_W)

    def path(self, p_W: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        towards, distance = -self.gradient(p_W), self.value(p_W)
        going = (np.asarray(lengths) < distance)[:, None]
        ends = p_W + np.minimum(lengths, distance)[:, None] * towards
        return ends, going * towards


@pytest.mark.parametrize("distance", [0.4, 1.5, 3.0, 4.9, 12.0])
def test_is_the_lattices_own(distance):
    """Among the lattice's trajectories is this one, at any distance from the goal."""
    rng = np.random.default_rng(0)
    lattice = TrajectoryLattice(LatticeConfig(speed=2.6))
    R_WB = RollPitchYaw(0.2, -0.3, 1.0).ToRotationMatrix().matrix()
    p_WB, v_WB = rng.normal(size=3), rng.normal(size=3)
    direction = np.array([2.0, -1.0, 0.4]) / np.linalg.norm([2.0, -1.0, 0.4])
    p_WG = p_WB + distance * direction
    a_WB = level_acceleration(R_WB, v_WB, QuadrotorParams())
    ways_W = lattice.trajectories(p_WB, v_WB, a_WB, _Open(p_WG)).positions[-1, :10]
    found = unobstructed_way(R_WB.T @ v_WB, R_WB.T @ (p_WG - p_WB), R_WB[2], 2.6)
    np.testing.assert_allclose(found @ R_WB.T + p_WB, ways_W, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_goals_told_as_at_the_reach_are_flown_on_to(dtype):
    """In any direction, a goal at the reach of two seconds, however that is rounded, is flown to as
    one beyond; one a hundredth nearer is arrived at, over half a metre ahead after a second."""
    directions = torch.from_numpy(np.random.default_rng(2).normal(size=(1000, 3))).to(dtype)
    directions = directions / directions.norm(dim=1, keepdim=True)
    up_B, basis = torch.tensor([0.0, 0.0, 1.0], dtype=dtype), torch.from_numpy(BASIS).to(dtype)
    at, beyond, within = (
        unobstructed_way(2.6 * directions, distance * directions, up_B, 2.6, basis)
        for distance in (5.2, 20.0, 5.15)
    )
    assert (at - beyond).abs().max() < 1e-5
    assert (within - beyond)[:, -1].norm(dim=1).min() > 0.5


def test_tensors_and_arrays_alike():
    """Of many states at once, in torch as in numpy; to a goal at hand it does not move."""
    rng = np.random.default_rng(1)
    v_B, goal_B, up_B = rng.normal(size=(3, 7, 3))
    goal_B[0] = v_B[0] = 0.0
    up_B /= np.linalg.norm(up_B, axis=1, keepdims=True)
    up_B[0] = 0.0, 0.0, 1.0
    expected = unobstructed_way(v_B, goal_B, up_B, 2.0)
    tensors = [torch.from_numpy(x) for x in (v_B, goal_B, up_B)]
    found = unobstructed_way(*tensors, 2.0, torch.from_numpy(BASIS))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    assert np.abs(expected[0]).max() < 1e-9 < np.abs(expected[1:]).max()
