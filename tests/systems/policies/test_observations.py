import numpy as np
import pytest

from splatpilot.systems.policies.base import inverse_depth, pool_depth, target_velocity


def test_pooling_keeps_the_minimum():
    depth = np.full((4, 6), 9.0)
    depth[1, 1], depth[3, 5], depth[0, 4] = 2.0, 0.0, np.inf
    np.testing.assert_array_equal(pool_depth(depth, 2, 3), [[2.0, 9.0, 9.0], [9.0, 9.0, 0.0]])


def test_inverse_depth_is_clipped():
    found = inverse_depth(np.array([0.0, 0.3, 3.0, 12.0, np.inf]), 0.3, 12.0)
    assert found == pytest.approx([9.4, 9.4, 0.4, -0.35, -0.35])


def test_target_velocity_points_to_the_goal_and_falls_near_it():
    p_WG = np.array([3.0, -4.0, 2.0])
    far = target_velocity(np.array([0.0, 0.0, 2.0]), p_WG, 2.0, 0.75)
    np.testing.assert_allclose(far, [1.2, -1.6, 0.0])
    near = target_velocity(p_WG - [0.3, 0.0, 0.0], p_WG, 2.0, 0.75)
    np.testing.assert_allclose(near, [0.4, 0.0, 0.0])
    np.testing.assert_array_equal(target_velocity(p_WG, p_WG, 2.0, 0.75), np.zeros(3))
