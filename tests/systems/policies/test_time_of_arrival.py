import copy

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot import _native
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box
from splatpilot.systems.policies.time_of_arrival import slowness, time_of_arrival
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


@pytest.mark.parametrize("voxel_size", [0.4, 0.2])
def test_is_the_distance_in_open_space(voxel_size):
    p_WG, shape = np.array([6.83, 2.21, 1.47]), np.rint(np.array([8.0, 6.0, 4.0]) / voxel_size)
    far, free = np.full(shape.astype(int), 50.0, np.float32), np.zeros(shape.astype(int), np.uint8)
    toa = time_of_arrival(Esdf(far, free, np.zeros(3), voxel_size, True), p_WG)
    assert copy.deepcopy(toa) is toa
    lower, upper = 0.5 * voxel_size, np.array([8.0, 6.0, 4.0]) - 0.5 * voxel_size
    p_WQ = np.random.default_rng(0).uniform(lower, upper, (5000, 3))
    error = toa.value(p_WQ) - np.linalg.norm(p_WQ - p_WG, axis=1)
    assert np.abs(error).max() < voxel_size
    assert np.abs(error).mean() < 0.35 * voxel_size


def test_travel_times_are_those_of_scikit_fmm():
    skfmm = pytest.importorskip("skfmm")
    rng = np.random.default_rng(0)
    for shape in [(24, 18, 11), (1, 30, 30), (9, 1, 2)]:
        cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
        front = 0.3 * np.linalg.norm(cells - rng.uniform(0.2, 0.8, 3) * shape, axis=-1) - 0.3
        speed = rng.uniform(0.05, 1.0, shape)
        blocked = (rng.random(shape) < 0.3) & (front > 0.3)
        expected = skfmm.travel_time(np.ma.MaskedArray(front, blocked), speed, dx=0.3, order=2)
        times = np.empty(shape)
        _native.travel_times(front=front, speed=speed, blocked=blocked, voxel_size=0.3, times=times)
        np.testing.assert_array_equal(times, np.ma.filled(expected, np.inf))


def test_goes_around_a_wall(half_wall):
    p_WG, p_WB = np.array([9.0, 2.0, 2.0]), np.array([3.0, 2.0, 2.0])
    toa = time_of_arrival(half_wall, p_WG)
    corner = np.array([6.2, 6.0 + VEHICLE_RADIUS, 2.0])
    shortest = np.linalg.norm(corner - p_WB) + np.linalg.norm(p_WG - corner)
    assert shortest < toa.value(p_WB) < 1.5 * shortest
    # Before the wall the path leads to its end and off the wall, not to the goal behind it.
    downhill = -toa.gradient(np.array([5.0, 3.0, 2.0]))
    assert downhill[1] > 0.5 and downhill[0] < 0.0


def test_gradient_is_the_slowness(pillar):
    toa = time_of_arrival(pillar, np.array([13.0, 4.0, 3.0]))
    p_WQ = np.random.default_rng(1).uniform([1.5, 1.5, 2], [10.0, 6.5, 4], (4000, 3))
    distance = pillar.distance(p_WQ)
    p_WQ = p_WQ[distance > VEHICLE_RADIUS + 0.3]
    ratio = np.linalg.norm(toa.gradient(p_WQ), axis=1) / slowness(pillar.distance(p_WQ))
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.mean(np.abs(ratio - 1.0) < 0.15) > 0.95


def test_path_goes_down_the_gradient(u_trap):
    toa = time_of_arrival(u_trap, np.array([10.0, 4.0, 2.0]))
    rng = np.random.default_rng(0)
    points = rng.uniform(u_trap.lower_W - 0.5, u_trap.upper_W + 0.5, (200, 3))
    for p_WQ, gradient in zip(points, toa.gradient(points), strict=True):
        if np.linalg.norm(toa.p_WG - p_WQ) < 1.0:
            continue
        down = -gradient / np.linalg.norm(gradient)
        step = max(toa.voxel_size, 0.1)
        ends, _ = toa.path(p_WQ, np.array([step]))
        np.testing.assert_allclose(ends[0], p_WQ + step * down, rtol=0, atol=1e-14)


def test_slowness_rises_toward_contact():
    distance = np.linspace(0.0, 6.0, 500)
    values = slowness(distance)
    assert np.all(np.diff(values) < 0.0)
    assert slowness(np.array(6.0)) == pytest.approx(1.0, abs=1e-6)
    assert 10.0 < slowness(np.array(VEHICLE_RADIUS)) < 12.0


def test_path_leads_to_the_goal(u_trap):
    p_WG = np.array([12.0, 5.0, 2.0])
    toa = time_of_arrival(u_trap, p_WG, margin=0.05)
    lengths = np.arange(0.0, 40.0, 0.2)
    points, directions = toa.path(np.array([7.0, 5.0, 2.0]), lengths)
    np.testing.assert_allclose(points[-1], p_WG)
    arrived = np.linalg.norm(points - p_WG, axis=1) < 1e-9
    np.testing.assert_array_equal(directions[arrived], 0.0)
    np.testing.assert_allclose(np.linalg.norm(directions[~arrived][1:], axis=1), 1.0)
    assert u_trap.distance(points).min() > VEHICLE_RADIUS
    assert points[:, 0].min() < 4.0  # out of the opening
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < 0.2 + 1e-9
    assert np.sum(steps) < 1.2 * toa.value(points[0])


def test_leads_out_of_obstacles_and_knows_what_is_cut_off(pillar, closed_wall):
    toa = time_of_arrival(pillar, np.array([13.0, 4.0, 3.0]))
    assert np.isfinite(toa.times).all()
    assert not toa.is_reachable(np.array([6.0, 4.0, 3.0]))
    assert toa.value(np.array([6.3, 4.0, 3.0])) > toa.value(np.array([6.9, 4.0, 3.0]))
    assert np.isfinite(toa.value(np.array([-50.0, 3.0, 900.0])))
    assert not toa.is_reachable(np.array([-50.0, 3.0, 900.0]))
    toa = time_of_arrival(closed_wall, np.array([9.0, 5.0, 2.0]))
    assert not toa.is_reachable(np.array([3.0, 5.0, 2.0]))
    assert toa.is_reachable(np.array([11.0, 2.0, 2.0]))


@pytest.mark.parametrize(
    ("p_WG", "message"),
    [
        ([6.0, 4.0, 3.0], r"at least 0.05 m.* got -0\.\d+ m.*further into free space"),
        ([0.1, 4.0, 3.0], r"at least 0.05 m.* got -0.25 m.*choose a goal 0.30 m further"),
        ([17.0, 4.0, 3.0], r"\[17.00, 4.00, 3.00\] m must be inside the known volume.*16.00"),
        ([np.nan, 4.0, 3.0], "must be 3 finite coordinates"),
    ],
)
def test_bad_goals_are_refused(pillar, p_WG, message):
    with pytest.raises(ValueError, match=message):
        time_of_arrival(pillar, np.array(p_WG), margin=0.05)
    unknown = Esdf(pillar.distances, pillar.states, pillar.lower_W, pillar.voxel_size)
    with pytest.raises(ValueError, match=r"pass esdf.conservative\(\)"):
        time_of_arrival(unknown, np.full(3, 0.9))


def test_a_goal_near_a_thin_wall_is_not_reached_through_it():
    lower, upper = np.zeros(3), np.array([12.0, 6.4, 4.0])
    wall = Box(RigidTransform([6.0, 3.2, 2.0]), np.array([0.1, 10.0, 10.0]))
    esdf = esdf_from_distance_field(AnalyticDistanceField([wall], lower, upper), 0.8).conservative()
    for x in np.linspace(6.46, 6.9, 12):
        toa = time_of_arrival(esdf, np.array([x, 3.2, 2.0]), margin=0.0)
        assert not toa.is_reachable(np.array([2.0, 3.2, 2.0]))
