import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.flatness import (
    attitude_error,
    attitude_from_thrust,
    limit_norm,
    limit_thrust,
    reaching_acceleration,
    thrust_for_acceleration,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, quadrotor_derivatives

# Vectors of ordinary and of extreme length, with exact zeros.
elements = st.floats(-20, 20) | st.sampled_from([0.0, 1e-12, -1e6])
vectors = st.lists(elements, min_size=3, max_size=3).map(np.array)
rotations = st.lists(st.floats(-1, 1), min_size=4, max_size=4).map(
    lambda q: Rotation.from_quat(np.array(q) + np.array([0.0, 0.0, 0.0, 1e-3]))
)
angles = st.floats(-math.pi, math.pi)


@given(p_WR=vectors, p_WB=vectors, v_WB=vectors, lookahead=st.floats(0.2, 2))
def test_reaching_acceleration_arrives(p_WR, p_WB, v_WB, lookahead):
    """Held for the lookahead, the acceleration takes the vehicle to the waypoint."""
    a_WB = reaching_acceleration(p_WR, p_WB, v_WB, lookahead)
    end = p_WB + lookahead * v_WB + lookahead**2 / 2 * a_WB
    np.testing.assert_allclose(end, p_WR, rtol=1e-9, atol=1e-8)


@given(a_WB=vectors, v_WB=vectors, yaw=angles)
def test_thrust_and_attitude_invert_the_dynamics(a_WB, v_WB, yaw):
    """With the thrust and the attitude found, the plant's acceleration is the one wanted."""
    params = QuadrotorParams(drag=0.4, gravity=9.7)
    f_W = thrust_for_acceleration(a_WB, v_WB, params.drag, params.gravity)
    R_WB = Rotation.from_matrix(attitude_from_thrust(f_W, yaw))
    state = np.concatenate([np.zeros(3), v_WB, R_WB.as_quat(scalar_first=True), np.zeros(3)])
    command = np.array([np.linalg.norm(f_W), 0.0, 0.0, 0.0])
    v_dot = quadrotor_derivatives(state, command, params)[3:6]
    np.testing.assert_allclose(v_dot, a_WB, rtol=1e-6, atol=1e-6)


@given(f_W=vectors, yaw=angles)
@example(f_W=np.zeros(3), yaw=0.3)
@example(f_W=np.array([0.0, 0.0, -9.81]), yaw=0.3)
@example(f_W=np.array([9.81, 0.0, 0.0]), yaw=0.0)  # pitched by 90 deg
@example(f_W=np.array([0.0, 9.81, 0.0]), yaw=0.0)  # rolled by 90 deg: heading undefined
@example(f_W=np.array([0.0, -9.81, 0.0]), yaw=math.pi)
def test_attitude_is_a_rotation_along_the_thrust(f_W, yaw):
    """The attitude is a proper rotation with z along the thrust, whatever the thrust."""
    R_WD = attitude_from_thrust(f_W, yaw)
    np.testing.assert_allclose(R_WD.T @ R_WD, np.eye(3), atol=1e-9)
    assert np.linalg.det(R_WD) == pytest.approx(1.0)
    if np.linalg.norm(f_W) > 1e-6:
        np.testing.assert_allclose(R_WD[:, 2], f_W / np.linalg.norm(f_W), atol=1e-9)


@given(f_W=vectors, yaw=angles)
def test_attitude_points_along_yaw_seen_from_above(f_W, yaw):
    """At any thrust with an upward or downward part, body x projects onto the heading."""
    assume(abs(f_W[2]) > 0.1 * np.linalg.norm(f_W) > 0.0)
    x_W = attitude_from_thrust(f_W, yaw)[:, 0]
    assert x_W @ [math.cos(yaw), math.sin(yaw), 0.0] > 0.0
    assert x_W @ [-math.sin(yaw), math.cos(yaw), 0.0] == pytest.approx(0.0, abs=1e-9)


def test_zero_thrust_is_level():
    """Without a thrust direction the attitude is level and faces yaw."""
    expected = Rotation.from_euler("z", 0.7).as_matrix()
    np.testing.assert_allclose(attitude_from_thrust(np.zeros(3), 0.7), expected, atol=1e-12)


@given(R_WB=rotations, R_WD=rotations)
def test_attitude_error_turns_b_into_d(R_WB, R_WD):
    """Turning by the tilt and then by the yaw gives exactly the desired attitude."""
    tilt_B, yaw = attitude_error(R_WB.as_matrix(), R_WD.as_matrix())
    turned = R_WB * Rotation.from_rotvec([*tilt_B, 0.0]) * Rotation.from_euler("z", yaw)
    np.testing.assert_allclose(turned.as_matrix(), R_WD.as_matrix(), atol=1e-6)


@given(R_WB=rotations, R_WD=rotations)
def test_the_tilt_is_the_shortest_turn(R_WB, R_WD):
    """The length of the tilt is the angle between the two z axes."""
    tilt_B, _ = attitude_error(R_WB.as_matrix(), R_WD.as_matrix())
    cosine = R_WB.as_matrix()[:, 2] @ R_WD.as_matrix()[:, 2]
    assert math.cos(np.linalg.norm(tilt_B)) == pytest.approx(cosine, abs=1e-9)
    assert np.linalg.norm(tilt_B) <= math.pi + 1e-9


def test_an_inverted_body_turns_over():
    """With opposite z axes the tilt is half a turn about body x, not a NaN and not zero."""
    tilt_B, yaw = attitude_error(np.eye(3), np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(tilt_B, [math.pi, 0.0])
    assert yaw == pytest.approx(0.0)


@given(f_W=vectors)
@example(f_W=np.zeros(3))
@example(f_W=np.array([30.0, -4.0, -9.81]))
def test_limited_thrust_is_within_the_limits_and_keeps_its_bearing(f_W):
    """Any thrust comes into the tilt cone and the thrust range without turning sideways."""
    limited = limit_thrust(f_W, 2.0, 20.0, 0.8)
    assert 2.0 - 1e-9 <= np.linalg.norm(limited) <= 20.0 + 1e-9
    assert math.hypot(*limited[:2]) <= math.tan(0.8) * limited[2] * (1 + 1e-9)
    assert limited[0] * f_W[1] == pytest.approx(limited[1] * f_W[0], rel=1e-9, abs=1e-9)
    assert limited[:2] @ f_W[:2] >= 0.0


def test_thrust_within_the_limits_is_unchanged():
    """An admissible thrust passes as it is."""
    f_W = np.array([3.0, -2.0, 9.0])
    np.testing.assert_allclose(limit_thrust(f_W, 2.0, 20.0, 0.8), f_W)


def test_limiting_the_tilt_keeps_the_vertical_thrust():
    """Too much sideways thrust is given up before any lift is."""
    limited = limit_thrust(np.array([40.0, 0.0, 9.81]), 2.0, 20.0, 0.8)
    np.testing.assert_allclose(limited, [9.81 * math.tan(0.8), 0.0, 9.81])


def test_limit_norm_shortens_only_what_is_too_long():
    """Length is cut at the limit and direction is kept."""
    np.testing.assert_array_equal(limit_norm(np.array([3.0, 4.0]), 5.0), [3.0, 4.0])
    np.testing.assert_allclose(limit_norm(np.array([3.0, 4.0]), 1.0), [0.6, 0.8])
    np.testing.assert_array_equal(limit_norm(np.zeros(2), 1.0), np.zeros(2))
