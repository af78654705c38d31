import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box
from splatpilot.training.captures.camera_path import (
    poses_along,
    visiting_path,
)

LOWER_W, UPPER_W = np.array([0.0, 0.0, 0.0]), np.array([12.0, 8.0, 3.0])


@pytest.fixture(scope="module")
def divided_hall() -> Esdf:
    # A wall divides it but for a gap at its upper end.
    wall = Box(RigidTransform([6.0, 3.0, 1.5]), [0.4, 6.0, 3.0])
    return esdf_from_distance_field(AnalyticDistanceField([wall], LOWER_W, UPPER_W), 0.1)


def test_path_visits_all_free_space_and_keeps_clear(divided_hall):
    clearance, apart = 0.5, 2.5
    lower_W, upper_W = np.array([0, 0, 1.0]), np.array([12, 8, 2.0])
    path = visiting_path(divided_hall, lower_W, upper_W, clearance, apart)
    assert divided_hall.conservative().distance(path).min() > clearance
    # Neighbors on a grid of 0.2 m: nothing is jumped over.
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.2 * np.sqrt(3) + 1e-9
    x, y = np.meshgrid(np.arange(1.0, 11.1, 0.5), np.arange(1.0, 7.1, 0.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    points = points[divided_hall.distance(points) > 0.8]
    nearest = np.linalg.norm(points[:, None] - path[None], axis=2).min(axis=1)
    assert nearest.max() < apart
    assert np.linalg.norm(path[0] - [6.0, 7.0, 1.5]) < apart


def test_path_names_the_largest_clearance(divided_hall):
    with pytest.raises(ValueError, match=r"largest clearance .* 9.0 m is required"):
        visiting_path(divided_hall, LOWER_W, UPPER_W, 9.0, 2.0)


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


def test_heading_stays_on_a_climb():
    path = np.array([[0.0, 0, 1], [3, 3, 1], [3, 3, 6]])
    ahead = np.array([X.rotation().matrix()[:, 2] for X in poses_along(path, 0.5, [0.0], 0.0)])
    np.testing.assert_allclose(ahead, np.tile([0.5**0.5, 0.5**0.5, 0], (len(ahead), 1)), atol=1e-6)


def test_one_point_is_one_stop():
    (X_WC,) = poses_along(np.array([[1.0, 2, 3]]), 0.5, [0.0], 0.0)
    np.testing.assert_array_equal(X_WC.translation(), [1, 2, 3])


@pytest.mark.parametrize("path", [[], [[1.0, 2]], [[1.0, 2, np.nan]]])
def test_invalid_paths_are_refused(path):
    with pytest.raises(ValueError, match="path must be of finite points x, y, z"):
        poses_along(np.array(path), 0.5, [0.0], 0.0)
