import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import (
    QuadrotorState,
    StatePredictor,
    StateToPose,
    lengths,
    pose_between,
    predict_state,
    rotation_matrices,
)
from tests.systems.vehicle.responses import evaluate


@pytest.mark.parametrize("x", [np.arange(13.0), torch.arange(78.0).reshape(2, 3, 13)])
def test_parts_are_views_where_the_plant_has_them(x):
    state = QuadrotorState.of(x)
    columns = ([0, 1, 2], [3, 4, 5], [6, 7, 8, 9], [10, 11, 12])
    for part, index in zip(state, columns, strict=True):
        np.testing.assert_array_equal(part, x[..., index])
    np.testing.assert_array_equal(state.to_vector(), x)
    state.v_WB[..., 1] = -3.0
    assert (x[..., 4] == -3.0).all() and (x == -3.0).sum() == len(x[..., 0].ravel())
    with pytest.raises(ValueError, match=r"got \(.*12,?\)"):
        QuadrotorState.of(x[..., :12])


def test_heading_and_tilt_are_those_of_the_body_axes():
    rotations, states = Rotation.random(20, random_state=0), np.zeros((20, 13))
    states[:, 6:10] = rotations.as_quat(scalar_first=True)
    x_W, z_W = rotations.apply([1.0, 0.0, 0.0]), rotations.apply([0.0, 0.0, 1.0])
    state = QuadrotorState.of(states)
    np.testing.assert_allclose(state.heading, np.arctan2(x_W[:, 1], x_W[:, 0]), atol=1e-12)
    np.testing.assert_allclose(state.tilt, np.arccos(z_W[:, 2]), atol=1e-7)


@settings(max_examples=30)
@given(q=st.lists(st.floats(-2, 2), min_size=4, max_size=4))
def test_pose_has_the_position_and_the_attitude_of_the_normalized_quaternion(q):
    assume(np.linalg.norm(q) > 1e-6)
    state = np.arange(13.0)
    state[6:10] = q
    X_WB = evaluate(StateToPose(), state=state)
    np.testing.assert_array_equal(X_WB.translation(), [0.0, 1.0, 2.0])
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(X_WB.rotation().matrix(), expected, atol=1e-12)


@pytest.mark.parametrize("w", [0.0, math.nan, math.inf])
def test_an_invalid_quaternion_is_an_error(w):
    state = hover_state([0.0, 0.0, 0.0])
    state[6] = w
    with pytest.raises(ValueError, match=f"q_WB must be .* got \\[{w}, "):
        evaluate(StateToPose(), state=state)


NUMBERS = st.floats(-3, 3)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)


@given(p=VECTORS, v=VECTORS, axis=VECTORS, w=VECTORS, duration=st.floats(0, 0.5))
def test_predicted_motion_is_that_of_drakes_rotations(p, v, axis, w, duration):
    q_WB = Quaternion(np.append(1.0, axis) / np.linalg.norm(np.append(1.0, axis)))
    state = np.concatenate([p, v, q_WB.wxyz(), w])
    later = QuadrotorState.of(predict_state(state, duration))
    np.testing.assert_allclose(later.p_WB, p + duration * v, atol=1e-12)
    np.testing.assert_array_equal(later.v_WB, v)
    np.testing.assert_array_equal(later.w_WB_B, w)
    rate = np.linalg.norm(w)
    axis = w / rate if rate > 1e-9 else np.array([1.0, 0.0, 0.0])
    rotated = q_WB.multiply(AngleAxis(rate * duration, axis).quaternion()).wxyz()
    np.testing.assert_allclose(later.q_WB, rotated, atol=1e-8)


@pytest.mark.parametrize(
    ("age", "moved"), [(0.0, 0.0), (0.05, 0.1), (0.5, 0.2), (-1.0, 0.0), (np.inf, 0.2)]
)
def test_ages_of_predictions_are_clipped(age, moved):
    state = np.array([1.0, 0, 0, 2, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    found = evaluate(StatePredictor(longest=0.1), measured_state=state, age=[age])
    assert found[0] == pytest.approx(1.0 + moved)


@pytest.mark.parametrize(("s", "yaw", "p"), [(0, 0.4, [1, 0, 0]), (0.5, 0.7, [2, 1, 0])])
def test_poses_between(s, yaw, p):
    X_0 = RigidTransform(RotationMatrix.MakeZRotation(0.4), [1.0, 0, 0])
    X_1 = RigidTransform(RotationMatrix.MakeZRotation(1.0), [3.0, 2, 0])
    expected = RigidTransform(RotationMatrix.MakeZRotation(yaw), p)
    assert pose_between(X_0, X_1, s).IsNearlyEqualTo(expected, 1e-12)
    assert pose_between(X_1, X_0, 1.0 - s).IsNearlyEqualTo(expected, 1e-12)
    assert pose_between(X_0, X_0, s).IsNearlyEqualTo(X_0, 1e-12)


@pytest.mark.parametrize("make", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
def test_rotation_matrices_are_scipys(make):
    q = 3.0 * np.random.default_rng(0).normal(size=(6, 4))
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrices(make(q)), expected, atol=1e-12)
    np.testing.assert_allclose(rotation_matrices(make(q[0])), expected[0], atol=1e-12)


def test_the_length_of_zero_has_no_gradient():
    zero = torch.zeros(2, 3, requires_grad=True)
    lengths(zero).sum().backward()
    assert zero.grad is not None and (zero.grad == 0).all()
