import numpy as np
import pytest

from splatpilot.training.captures.coverage import poses_along


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
