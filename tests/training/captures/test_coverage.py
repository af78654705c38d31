from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.mesh import mesh_distance
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box
from splatpilot.training.captures.capture import pinhole
from splatpilot.training.captures.coverage import CapturePlan, plan_capture, poses_along

K, SIZE = pinhole(160.0, 160.0, 160.0, 120.0), (320, 240)
LENGTH, WIDTH, HEIGHT = 12.0, 8.0, 3.0  # [m] of a hall


def box(lower, upper) -> Box:
    lower, upper = np.array(lower, float), np.array(upper, float)
    return Box(RigidTransform(0.5 * (lower + upper)), upper - lower)


@pytest.fixture(scope="module")
def field() -> Esdf:
    """A closed hall with a wall in its middle that leaves a gap, in a larger box of free space."""
    t, margin = 0.3, 3.0  # [m]
    solids = [
        box([-t, -t, -t], [LENGTH + t, WIDTH + t, 0]),
        box([-t, -t, HEIGHT], [LENGTH + t, WIDTH + t, HEIGHT + t]),
        box([-t, -t, 0], [0, WIDTH + t, HEIGHT]),
        box([LENGTH, -t, 0], [LENGTH + t, WIDTH + t, HEIGHT]),
        box([0, -t, 0], [LENGTH, 0, HEIGHT]),
        box([0, WIDTH, 0], [LENGTH, WIDTH + t, HEIGHT]),
        box([5.9, 0, 0], [6.1, 6, HEIGHT]),
        box([-margin, -margin, -1.0], [LENGTH + margin, WIDTH + margin, -t]),
    ]
    lower_W = np.array([-margin, -margin, -0.9])
    upper_W = np.array([LENGTH + margin, WIDTH + margin, 4.5])
    return esdf_from_distance_field(AnalyticDistanceField(solids, lower_W, upper_W), 0.1)


@pytest.fixture(scope="module")
def plan(field) -> CapturePlan:
    return plan_capture(field, K, SIZE, (1.0, 2.2), 0.4)


def positions(plan: CapturePlan) -> np.ndarray:
    return np.array([X_WC.translation() for X_WC in plan.X_WCs])


def test_poses_are_free_and_inside(field, plan):
    p_WC = positions(plan)
    assert field.distance(p_WC).min() > 0.4
    assert (p_WC > 0).all() and (p_WC < [LENGTH, WIDTH, HEIGHT]).all()
    assert p_WC[:, 2].min() > 0.99 and p_WC[:, 2].max() < 2.3


def test_surfaces_are_seen_from_three_directions(plan):
    assert plan.coverage > 0.85 and (plan.views > 0).mean() > 0.97
    assert 20 < len(plan.X_WCs) < 250 and plan.more_frames == 0
    # An own count: patches within reach, in the field of view, from cells of directions. The middle
    # wall alone can hide them; so half of the hall is looked at.
    west = plan.p_WQ[:, 0] < 5.8
    cells = [set() for _ in plan.p_WQ]
    for X_WC in plan.X_WCs:
        if X_WC.translation()[0] > 5.8:
            continue
        p_CQ = X_WC.inverse().multiply(plan.p_WQ.T)
        u, v = (K @ p_CQ)[:2] / p_CQ[2]
        seen = (p_CQ[2] > 0) & (u >= 0) & (u <= SIZE[0]) & (v >= 0) & (v <= SIZE[1])
        toward = X_WC.translation() - plan.p_WQ
        distance = np.linalg.norm(toward, axis=1)
        for k in np.flatnonzero(seen & (distance <= plan.reach) & west):
            cells[k].add(tuple(np.round(toward[k] / distance[k])))
    assert np.mean([len(cells[k]) >= 3 for k in np.flatnonzero(west)]) > 0.85


def test_too_few_frames_and_too_little_clearance_are_reported(field, plan):
    some = plan_capture(field, K, SIZE, (1.0, 2.2), 0.4, max_frames=10)
    assert len(some.X_WCs) == 10
    assert some.more_frames == len(plan.X_WCs) - 10
    assert some.coverage < plan.coverage
    red, more = ((each.picture() == [220, 0, 0]).all(axis=2).sum() for each in (plan, some))
    assert more > 4 * red
    with pytest.raises(ValueError, match=r"9.0 m must exist, got none in .* m; correct the scale"):
        plan_capture(field, K, SIZE, (1.0, 2.2), 9.0)
    assert not plan.others
    [(area, p_W)] = plan_capture(field, K, SIZE, (1.0, 2.2), 1.1).others  # The gap is 2 m wide.
    assert 15 < area < 25 and (p_W > 1.0).all() and (p_W < [LENGTH - 1, WIDTH - 1, 2]).all()


def test_space_outside_is_captured_on_request(field):
    plan = plan_capture(field, K, SIZE, (1.0, 2.2), 0.4, inside=np.array([-2.0, -2.0, 1.0]))
    p_WC = positions(plan)
    assert ((p_WC < 0) | (p_WC > [LENGTH, WIDTH, 10])).any(axis=1).all()


def test_heights_are_above_the_ground(tmp_path: Path):
    x, y = np.meshgrid(np.linspace(0, 20, 41), np.linspace(0, 12, 25), indexing="ij")
    grid = np.arange(x.size).reshape(x.shape)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    ground = trimesh.Trimesh(np.stack([x, y, 0.4 * x], -1).reshape(-1, 3), faces, process=False)
    at = trimesh.transformations.translation_matrix([10, 6, 7])
    post = trimesh.creation.box([0.4, 0.4, 14.0], at)
    trimesh.util.concatenate([ground, post]).export(tmp_path / "hill.obj")
    esdf = mesh_distance(tmp_path / "hill.obj", "z", 0.2)
    p_WC = positions(plan_capture(esdf, K, SIZE, (1.0, 2.5), 0.5, reach=5.0))
    above = p_WC[:, 2] - 0.4 * p_WC[:, 0]
    assert 0.7 < above.min() and above.max() < 2.9
    assert np.ptp(p_WC[:, 2]) > 4.0


def test_ground_at_the_lower_end_of_the_field_is_a_surface():
    solids = [box([-1.0, -1.0, -1.0], [9.0, 7.0, 0.0]), box([3.5, 2.0, 0.0], [4.5, 4.0, 3.0])]
    distances = AnalyticDistanceField(solids, np.zeros(3), np.array([8.0, 6.0, 3.0]))
    plan = plan_capture(esdf_from_distance_field(distances, 0.1), K, SIZE, (1.0, 2.2), 0.4)
    heights = positions(plan)[:, 2]
    assert plan.free_area > 0.8 * 8.0 * 6.0
    assert heights.min() >= 1.0 and heights.max() <= 2.2


def test_poses_stop_evenly_and_look_ahead_and_aside():
    path = np.array([[1.0, 2, 1.5], [1, 8, 1.5]])
    X_WCs = poses_along(path, 0.5, [0.0, 90.0, -90.0], -10.0)
    assert len(X_WCs) == 3 * 13
    p_WC = np.array([X.translation() for X in X_WCs]).reshape(13, 3, 3)
    assert np.ptp(p_WC, axis=1).max() == 0
    steps = np.linalg.norm(np.diff(p_WC[:, 0], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-9)
    c, s = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    for X_WC, ahead in zip(X_WCs, 13 * [[0, c, -s], [-c, 0, -s], [c, 0, -s]], strict=True):
        R_WC = X_WC.rotation().matrix()
        np.testing.assert_allclose(R_WC[:, 2], ahead, atol=1e-12)
        assert abs(R_WC[2, 0]) < 1e-12  # x is level,
        assert R_WC[2, 1] < 0  # and y points down.
    (X_WC,) = poses_along(np.array([[1.0, 2, 3]]), 0.5, [0.0], 0.0)
    np.testing.assert_array_equal(X_WC.translation(), [1, 2, 3])
    climb = np.array([[0.0, 0, 1], [3, 3, 1], [3, 3, 6]])
    for X_WC in poses_along(climb, 0.5, [0.0], 0.0):
        ahead = X_WC.rotation().matrix()[:, 2]
        np.testing.assert_allclose(ahead, [0.5**0.5, 0.5**0.5, 0], atol=1e-6)


@pytest.mark.parametrize("path", [[], [[1.0, 2]], [[1.0, 2, np.nan]]])
def test_invalid_paths_are_refused(path):
    with pytest.raises(ValueError, match="path must be of finite points x, y, z"):
        poses_along(np.array(path), 0.5, [0.0], 0.0)
