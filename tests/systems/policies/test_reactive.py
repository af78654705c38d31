import numpy as np
import pytest

from splatpilot.systems.policies.base import observation
from splatpilot.systems.policies.lattice import LatticeConfig, final_velocities
from splatpilot.systems.policies.reactive import (
    ReactiveConfig,
    candidate_costs,
    candidate_velocities,
    compute_command,
    is_seen,
    nearest_points,
    responses,
)
from splatpilot.systems.policies.velocity import RESPONSE_TIME
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state

CONFIG = ReactiveConfig()
STATE = hover_state([0.0, 0.0, 2.0])


def empty_image() -> np.ndarray:
    return np.full((CONFIG.camera.height, CONFIG.camera.width), np.inf)


def test_nearest_points_are_those_of_single_pixels():
    depth = empty_image()
    depth[5, 9], depth[6, 10] = 2.0, 3.0  # Both in block (1, 2).
    depth[35, 63] = 0.0
    points = nearest_points(depth, CONFIG).reshape(CONFIG.rows, CONFIG.columns, 3)
    np.testing.assert_allclose(points[1, 2], 2.0 * CONFIG.camera.ray_slopes()[5, 9])
    assert np.isfinite(points[..., 0]).sum() == 1


def test_responses_solve_the_tracking_equation():
    p, v = np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0, -1.0])
    desired = np.array([0.0, 1.0, 1.0])
    positions = responses(p, v, desired[None])[0]
    step, expected = 1e-4, []
    for k in range(1, 15001):
        v = v + step * (desired - v) / RESPONSE_TIME
        p = p + step * v
        if k % 2500 == 0:
            expected.append(p)
    np.testing.assert_allclose(positions, expected, atol=1e-3)


def test_seen_is_inside_the_image_and_before_its_depth():
    depth = empty_image()
    depth[:] = 4.0
    points = np.array([[0, 0, 3.9], [0, 0, 4.1], [1.9, 0, 2], [2.1, 0, 2], [0, 0, -1]], float)
    np.testing.assert_array_equal(
        is_seen(points, depth, CONFIG.camera), [True, False, True, False, False]
    )


def cost_of(points_W, velocities, seen=True):
    p_WB, v_WB, p_WG = np.zeros(3), np.array([2.0, 0, 0]), np.array([10.0, 0, 0])
    velocities = np.array(velocities, dtype=float)
    positions = responses(p_WB, v_WB, velocities)
    rest = np.reshape(points_W, (-1, 3)), np.full(positions.shape[:2], seen), CONFIG
    return candidate_costs(positions, velocities, p_WB, v_WB, p_WG, *rest), positions


def test_contact_and_the_unseen_cost():
    ahead = [2.0, 0, 0]
    (through, beside), _ = cost_of([[2.0, 0, 0]], [ahead, [1.2, 1.2, 0]])
    assert through > beside
    (hit,), _ = cost_of([[2.0, 0, 0]], [ahead])
    (missed,), _ = cost_of([[2.0, VEHICLE_RADIUS + CONFIG.margin + 0.1, 0]], [ahead])
    assert hit > missed + 10.0
    (unseen,), positions = cost_of([], [ahead], seen=False)
    (seen,), _ = cost_of([], [ahead])
    far = positions[0, :, 0] > 0.6
    steps = np.diff(positions[0, :, 0], prepend=0.0)
    assert unseen - seen == pytest.approx(2.0 * steps[far].sum())


def test_candidates_are_those_of_the_planner():
    yaw, pitch = np.deg2rad([100.0, 25.0])
    angles = {"max_yaw": yaw, "max_pitch": pitch, "num_yaws": 17, "num_pitches": 3}
    v = candidate_velocities(np.array([1.0, 0.0, 0.0]), CONFIG)
    lattice = final_velocities(LatticeConfig(**angles))
    np.testing.assert_allclose(v, CONFIG.speed * lattice, atol=1e-12)
    assert np.arctan2(v[:, 1], v[:, 0]).max() == pytest.approx(yaw)


NO_POINTS = np.full((CONFIG.memory * CONFIG.rows * CONFIG.columns, 3), np.nan)


def test_flies_ahead_in_the_open_and_aside_of_a_post():
    post, p_WG = empty_image(), np.array([10.0, 0.0, 2.0])
    post[:, 26:34] = 2.0  # From left of the middle to just right of it.
    ahead, right, left = (
        compute_command(observation(0.0, STATE, p_WG, depth), NO_POINTS, CONFIG)[0]
        for depth in (empty_image(), post, post[:, ::-1])
    )
    assert ahead[0] > 3.0 and np.abs(ahead[1:]).max() < 0.5
    assert right[1] < -0.5 and left[1] == pytest.approx(-right[1])


def test_remembers_points_that_are_no_longer_seen():
    config, points = ReactiveConfig(memory=2), NO_POINTS[: 2 * 144]
    for k, depth in enumerate((3.0, np.inf, np.inf, np.inf)):
        depth = np.full_like(empty_image(), depth)
        seen = observation(0.0, hover_state([0, 0, 2], np.pi / 2), np.array([0.0, 10, 2]), depth)
        _, points = compute_command(seen, points, config)
        known = points[np.isfinite(points[:, 0])]
        assert len(known) == (144 if k < 2 else 0)
        np.testing.assert_allclose(known[:, 1], 3.1, atol=1e-6)
