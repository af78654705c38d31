"""Frames, against other implementations of rotations."""

import math

import numpy as np
import pytest
from pymavlink.quaternion import Quaternion
from pymavlink.rotmat import Matrix3, Vector3
from scipy.spatial.transform import Rotation

from splatpilot.systems.px4.frames import (
    attitude_from_optitrack,
    from_optitrack,
    swap_px4,
    swap_px4_attitude,
    thrust_to_px4,
)

NED_FROM_W = Rotation.from_euler("x", 180, degrees=True)
"""Half a turn about north: W is x north, y west, z up."""
ATTITUDES = Rotation.random(20, random_state=0)


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1)


def assert_same_attitude(q: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(q * np.sign(q.dot(expected)), expected, atol=1e-12)


def test_vectors_are_turned_as_scipy_turns_them():
    for v in np.random.default_rng(0).normal(size=(10, 3)):
        np.testing.assert_allclose(swap_px4(v), NED_FROM_W.apply(v), atol=1e-12)
        np.testing.assert_allclose(swap_px4(swap_px4(v)), v)
    np.testing.assert_array_equal(swap_px4(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_attitudes_are_those_of_scipy_and_of_pymavlink():
    for R_WB in ATTITUDES:
        q = swap_px4_attitude(wxyz(R_WB))
        assert_same_attitude(q, wxyz(NED_FROM_W * R_WB * NED_FROM_W.inv()))
        assert_same_attitude(swap_px4_attitude(q), wxyz(R_WB))
        dcm = Quaternion(q).dcm
        forward, left = R_WB.apply([1.0, 0, 0]), R_WB.apply([0.0, 1, 0])
        for axis, ours in ((Vector3(1, 0, 0), forward), (Vector3(0, 1, 0), -left)):
            pointed = dcm * axis
            found = [pointed.x, pointed.y, pointed.z]
            np.testing.assert_allclose(found, NED_FROM_W.apply(ours), atol=1e-6)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.3)])
def test_euler_angles_have_the_signs_of_aviation(roll, pitch, yaw):
    matrix = Matrix3()
    matrix.from_euler(roll, pitch, yaw)
    q = np.array(Quaternion(matrix).q)
    rotation = Rotation.from_quat(np.roll(swap_px4_attitude(q), -1))
    np.testing.assert_allclose(rotation.as_rotvec(), [roll, -pitch, -yaw], atol=1e-6)


def test_heading_is_the_yaw_of_the_attitude():
    for heading in (-2.0, 0.0, 0.7, 3.0):
        q = swap_px4_attitude(wxyz(Rotation.from_euler("z", heading)))
        _, _, yaw = Quaternion(q).dcm.to_euler()
        assert math.remainder(-heading - yaw, math.tau) == pytest.approx(0, abs=1e-9)


def test_optitrack_is_px4s_recipe():
    for v in np.random.default_rng(1).normal(size=(10, 3)):
        x, y, z = v
        np.testing.assert_allclose(swap_px4(from_optitrack(v)), [x, z, -y])
    for rotation in ATTITUDES:
        x, y, z, w = rotation.as_quat()
        q_WB = attitude_from_optitrack(rotation.as_quat())
        np.testing.assert_allclose(swap_px4_attitude(q_WB), [w, x, z, -y])


def test_optitracks_attitudes_are_those_of_scipy():
    W_from_O = Rotation.from_euler("x", 90, degrees=True)
    for R_OR in ATTITUDES:
        expected = wxyz(W_from_O * R_OR * W_from_O.inv())
        assert_same_attitude(attitude_from_optitrack(R_OR.as_quat()), expected)
        v = R_OR.apply([1.0, 2.0, 3.0])
        np.testing.assert_allclose(from_optitrack(v), W_from_O.apply(v), atol=1e-12)


def test_hover_thrust_carries_the_weight():
    assert thrust_to_px4(9.81, 0.45, 9.81) == 0.45
    assert thrust_to_px4(19.62, 0.45, 9.81) == 0.9
    assert (thrust_to_px4(99.0, 0.45, 9.81), thrust_to_px4(-1.0, 0.45, 9.81)) == (1.0, 0.0)
