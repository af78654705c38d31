import itertools

import numpy as np
import pytest
import torch
from numpy.polynomial import Polynomial
from pydrake.math import RollPitchYaw

from splatpilot.systems.policies import lattice
from splatpilot.systems.policies.lattice import (
    BASIS,
    LatticeConfig,
    Trajectories,
    TrajectoryLattice,
    final_velocities,
    level_acceleration,
    quintic_basis,
    reference_trajectory,
    rotation_to,
    select_distinct,
)
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams


def test_fan_of_final_velocities():
    config = LatticeConfig()
    velocities = final_velocities(config)
    assert velocities.shape == (25 * 7 * 3 + 1, 3)
    np.testing.assert_array_equal(velocities[-1], 0.0)
    speeds = np.linalg.norm(velocities[:-1], axis=1)
    np.testing.assert_allclose(np.unique(speeds.round(9)), config.speed_fractions)
    yaw = np.arctan2(velocities[:-1, 1], velocities[:-1, 0])
    assert yaw.max() == pytest.approx(config.max_yaw) == pytest.approx(-yaw.min())
    pitch = np.arcsin(velocities[:-1, 2] / speeds)
    assert pitch.max() == pytest.approx(0.5) == pytest.approx(-pitch.min())
    assert np.any(np.all(np.abs(velocities - [1, 0, 0]) < 1e-12, axis=1))


def test_trajectories_keep_their_ends(pillar_toa):
    lattice, toa = TrajectoryLattice(), pillar_toa
    p, v, a = np.array([2.0, 3.0, 2.0]), np.array([1.5, 0.3, -0.2]), np.array([0.5, -1.0, 0.0])
    trajectories = lattice.trajectories(p, v, a, toa)
    assert trajectories.positions.shape == (25 * 7 * 3 + 1 + 3, 20, 3)
    # Third-order exact near the start: p + v t + a t^2 / 2 + j t^3 / 6 + O(t^4).
    t, j = 0.1, trajectories.jerks[:, 0]
    start = p + v * t + a * t**2 / 2 + j * t**3 / 6
    assert np.abs(trajectories.positions[:, 0] - start).max() < 0.01
    R_WL = rotation_to(-toa.gradient(p))
    ends = p + 2.0 * 2.0 * final_velocities(lattice.config) @ R_WL.T
    np.testing.assert_allclose(trajectories.positions[:-3, -1], ends, atol=1e-12)
    path, _ = toa.path(p, 4.0 * np.array(lattice.config.speed_fractions))
    np.testing.assert_allclose(trajectories.positions[-3:, -1], path, atol=1e-12)


def test_plans_are_the_best_of_all_trajectories(pillar, pillar_toa, monkeypatch):
    instance = TrajectoryLattice()
    few, all_of_them, sizes = [], [], []
    costs = TrajectoryLattice.costs
    monkeypatch.setattr(
        TrajectoryLattice,
        "costs",
        lambda self, some, *rest: sizes.append(len(some.positions)) or costs(self, some, *rest),
    )
    for plans, count in ((few, lattice._FIRST_COUNT), (all_of_them, 10_000)):
        monkeypatch.setattr(lattice, "_FIRST_COUNT", count)
        rng = np.random.default_rng(0)
        for _ in range(30):
            p, v = rng.uniform([1.0, 1.0, 1.0], [13.0, 7.0, 4.0]), rng.normal(size=3)
            plans.append(instance.best(p, v, rng.normal(size=3), pillar, pillar_toa))
    for found, expected in zip(few, all_of_them, strict=True):
        for values, exact in zip(found, expected, strict=True):
            np.testing.assert_array_equal(values, exact)
    assert np.median(sizes[: len(sizes) // 2]) < 100  # It pays.


def test_costs_are_the_documented_sum(pillar, pillar_toa):
    config = LatticeConfig(penetration_weight=7.0, speed_weight=3.0, jerk_weight=0.5, margin=0.2)
    lattice, toa = TrajectoryLattice(config), pillar_toa
    p = np.array([4.0, 4.0, 3.0])
    positions = p + np.linspace(0.06, 1.2, 20)[:, None] * [1.0, 0.3, 0.0]
    jerks = np.random.default_rng(0).normal(size=(1, 20, 3))
    positions[10:] += [0.4, 0.0, 0.0]  # one step too fast
    [cost] = lattice.costs(Trajectories(positions[None], jerks), p, pillar, toa)

    expected = float(toa.value(positions[-1]))
    for i, q in enumerate(positions):
        step = np.linalg.norm(q - (positions[i - 1] if i else p))
        d = float(pillar.distance(q))
        speed = 0.1 + 0.9 * min(max((d - VEHICLE_RADIUS) / 0.6, 0.0), 1.0)
        soft = np.log1p(np.exp(4.0 * (VEHICLE_RADIUS + 1.0 - d))) / 4.0
        expected += (1.0 / speed + 1.5 * soft - 1.0) * step
        expected += 7.0 * max(0.0, VEHICLE_RADIUS + 0.2 - d)
        expected += 3.0 * max(0.0, step / 0.1 - 2.0) ** 2 / 20
        expected += 0.5 * np.sum(jerks[0, i] ** 2) / 20
    assert cost == pytest.approx(expected, rel=1e-9)


def test_best_are_in_order_and_distinct(pillar, pillar_toa):
    lattice, toa = TrajectoryLattice(LatticeConfig(num_hypotheses=5)), pillar_toa
    p, v, a = np.array([3.0, 4.1, 3.0]), np.array([2.0, 0.0, 0.0]), np.zeros(3)
    positions, costs = lattice.best(p, v, a, pillar, toa)
    assert positions.shape == (5, 20, 3)
    assert np.all(np.diff(costs) >= 0.0)
    assert costs[0] == lattice.costs(lattice.trajectories(p, v, a, toa), p, pillar, toa).min()
    for one, other in itertools.combinations(positions, 2):
        assert np.linalg.norm(one - other, axis=1).mean() > 0.35


class _Open:
    def __init__(self, p_WG: np.ndarray) -> None:
        self.p_WG = p_WG

    def value(self, p_W: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p_W - self.p_WG, axis=-1)

    def gradient(self, p_W: np.ndarray) -> np.ndarray:
        return (p_W - self.p_WG) / self.value(p_W)

    def path(self, p_W: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        toward, distance = -self.gradient(p_W), self.value(p_W)
        going = (np.asarray(lengths) < distance)[:, None]
        ends = p_W + np.minimum(lengths, distance)[:, None] * toward
        return ends, going * toward


@pytest.mark.parametrize("distance", [0.4, 1.5, 3.0, 4.9, 12.0])
def test_is_the_lattices_own(distance):
    rng = np.random.default_rng(0)
    lattice = TrajectoryLattice(LatticeConfig(speed=2.6))
    R_WB = RollPitchYaw(0.2, -0.3, 1.0).ToRotationMatrix().matrix()
    p_WB, v_WB = rng.normal(size=3), rng.normal(size=3)
    direction = np.array([2.0, -1.0, 0.4]) / np.linalg.norm([2.0, -1.0, 0.4])
    p_WG = p_WB + distance * direction
    a_WB = level_acceleration(R_WB, v_WB, QuadrotorParams())
    paths_W = lattice.trajectories(p_WB, v_WB, a_WB, _Open(p_WG)).positions[-1, :10]
    found = reference_trajectory(R_WB.T @ v_WB, R_WB.T @ (p_WG - p_WB), R_WB[2], 2.6)
    np.testing.assert_allclose(found @ R_WB.T + p_WB, paths_W, atol=1e-9)


def test_goals_at_the_reach_are_passed_at_speed():
    directions = torch.from_numpy(np.random.default_rng(2).normal(size=(1000, 3))).float()
    directions = directions / directions.norm(dim=1, keepdim=True)
    up_B, basis = torch.tensor([0.0, 0.0, 1.0]), torch.from_numpy(BASIS).float()
    at, beyond, within = (
        reference_trajectory(2.6 * directions, distance * directions, up_B, 2.6, basis)
        for distance in (5.2, 20.0, 5.15)
    )
    assert (at - beyond).abs().max() < 1e-5
    assert (within - beyond)[:, -1].norm(dim=1).min() > 0.5


def test_tensors_and_arrays_alike():
    rng = np.random.default_rng(1)
    v_B, goal_B, up_B = rng.normal(size=(3, 7, 3))
    goal_B[0] = v_B[0] = 0.0
    up_B /= np.linalg.norm(up_B, axis=1, keepdims=True)
    up_B[0] = 0.0, 0.0, 1.0
    expected = reference_trajectory(v_B, goal_B, up_B, 2.0)
    tensors = [torch.from_numpy(x) for x in (v_B, goal_B, up_B)]
    found = reference_trajectory(*tensors, 2.0, torch.from_numpy(BASIS))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    assert np.abs(expected[0]).max() < 1e-9 < np.abs(expected[1:]).max()


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_quintics_equal_the_polynomial(derivative):
    polynomial = Polynomial([0.3, -1.0, 2.0, 0.7, -0.4, 0.09])
    times, horizon = np.linspace(0.0, 2.0, 21), 2.0
    boundary = [polynomial.deriv(order)(t) for t in (0.0, horizon) for order in range(3)]
    np.testing.assert_allclose(
        quintic_basis(times, horizon, derivative) @ boundary,
        polynomial.deriv(derivative)(times) if derivative else polynomial(times),
        atol=1e-11,
    )


@pytest.mark.parametrize("direction", [[3, 0, 0], [-1, 2, 0.5], [0, 0, 2], [0, 0, -1], [0, 0, 0]])
def test_lattice_frame(direction):
    direction = np.array(direction, dtype=float)
    R_WL = rotation_to(direction)
    np.testing.assert_allclose(R_WL.T @ R_WL, np.eye(3), atol=1e-14)
    assert np.linalg.det(R_WL) == pytest.approx(1.0)
    np.testing.assert_allclose(R_WL[:, 0] * np.linalg.norm(direction), direction, atol=1e-14)
    assert R_WL[2, 1] == 0.0


def test_selection_falls_back_to_the_most_distant():
    positions = np.array([0.0, 0.01, 0.02, 1.0, 0.03])[:, None, None] * np.ones((5, 4, 3))
    costs = np.array([1.0, 2.0, 3.0, 9.0, 4.0])
    np.testing.assert_array_equal(select_distinct(positions, costs, 3, 0.35)[0], [0, 4, 3])
    np.testing.assert_array_equal(select_distinct(positions, costs, 5, 0.35)[0], [0, 1, 2, 4, 3])
    alike = np.zeros((3, 4, 3))
    np.testing.assert_array_equal(select_distinct(alike, costs[:3], 3, 0.35)[0], [0, 1, 2])


def test_level_acceleration():
    params = QuadrotorParams(drag=0.4, gravity=3.7)
    R_WB = RollPitchYaw(0.0, 0.3, 1.0).ToRotationMatrix().matrix()
    expected = 3.7 * np.tan(0.3) * np.array([np.cos(1.0), np.sin(1.0), 0.0])
    np.testing.assert_allclose(level_acceleration(R_WB, np.zeros(3), params), expected, atol=1e-12)
    v_WB = np.array([*expected[:2] / 0.4, -3.0])
    np.testing.assert_allclose(level_acceleration(R_WB, v_WB, params), 0.0, atol=1e-12)
