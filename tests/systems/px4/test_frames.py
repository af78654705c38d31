"""Frames, against other implementations of rotations."""

import math

import numpy as np
import pytest
from pymavlink.quaternion import Quaternion
from pymavlink.rotmat import Matrix3, Vector3
from scipy.spatial.transform import Rotation

from splatpilot.systems.px4.frames import (
    attitude_from_optitrack,
    attitude_from_px4,
    attitude_to_px4,
    from_optitrack,
    from_px4,
    heading_to_px4,
    thrust_to_px4,
    to_px4,
)

NED_FROM_W = Rotation.from_euler("x", 180, degrees=True)
"""Half a turn about north: W is x north, y west, z up."""
ATTITUDES = Rotation.random(20, random_state=0)


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1)


def assert_same_attitude(q: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(q * np.sign(q.dot(expected)), expected, atol=1e-12)


def test_vectors_are_turned_as_scipy_turns_them():
    """North stays north, west becomes minus east, up minus down, and back again."""
    for v in np.random.default_rng(0).normal(size=(10, 3)):
        np.testing.assert_allclose(to_px4(v), NED_FROM_W.apply(v), atol=1e-12)
        np.testing.assert_allclose(from_px4(to_px4(v)), v)
    np.testing.assert_array_equal(to_px4(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_attitudes_are_those_of_scipy_and_of_pymavlink():
    """PX4's attitude turns PX4's body axes to where ours point, by scipy's rotations and by the
    matrices of pymavlink, whose Euler angles it has."""
    for R_WB in ATTITUDES:
        q = attitude_to_px4(wxyz(R_WB))
        assert_same_attitude(q, wxyz(NED_FROM_W * R_WB * NED_FROM_W.inv()))
        assert_same_attitude(attitude_from_px4(q), wxyz(R_WB))
        dcm = Quaternion(q).dcm
        forward, left = R_WB.apply([1.0, 0, 0]), R_WB.apply([0.0, 1, 0])
        for axis, ours in ((Vector3(1, 0, 0), forward), (Vector3(0, 1, 0), -left)):
            pointed = dcm * axis
            found = [pointed.x, pointed.y, pointed.z]
            np.testing.assert_allclose(found, NED_FROM_W.apply(ours), atol=1e-6)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.3)])
def test_euler_angles_have_the_signs_of_aviation(roll, pitch, yaw):
    """A roll to the right, a nose up and a turn to the right, in pymavlink's words, are a turn
    about x, one about minus y and one about minus z in ours."""
    matrix = Matrix3()
    matrix.from_euler(roll, pitch, yaw)
    q = np.array(Quaternion(matrix).q)
    rotation = Rotation.from_quat(np.roll(attitude_from_px4(q), -1))
    np.testing.assert_allclose(rotation.as_rotvec(), [roll, -pitch, -yaw], atol=1e-6)


def test_heading_is_the_yaw_of_the_attitude():
    """The yaw that is sent for a heading is that of a body that looks there, by pymavlink."""
    for heading in (-2.0, 0.0, 0.7, 3.0):
        q = attitude_to_px4(wxyz(Rotation.from_euler("z", heading)))
        _, _, yaw = Quaternion(q).dcm.to_euler()
        assert math.remainder(heading_to_px4(heading) - yaw, math.tau) == pytest.approx(0, abs=1e-9)


def test_optitrack_is_px4s_recipe():
    """PX4's documentation makes (x, z, -y) of a position of OptiTrack, and the same of the vector
    part of a quaternion; here that is the local frame of what we make of it."""
    for v in np.random.default_rng(1).normal(size=(10, 3)):
        x, y, z = v
        np.testing.assert_allclose(to_px4(from_optitrack(v)), [x, z, -y])
    for rotation in ATTITUDES:
        x, y, z, w = rotation.as_quat()
        q_WB = attitude_from_optitrack(rotation.as_quat())
        np.testing.assert_allclose(attitude_to_px4(q_WB), [w, x, z, -y])


def test_optitracks_attitudes_are_those_of_scipy():
    """W is OptiTrack's world turned a quarter about x, and so are the bodies: attitudes are turned
    from both sides."""
    W_from_O = Rotation.from_euler("x", 90, degrees=True)
    for R_OR in ATTITUDES:
        expected = wxyz(W_from_O * R_OR * W_from_O.inv())
        assert_same_attitude(attitude_from_optitrack(R_OR.as_quat()), expected)
        v = R_OR.apply([1.0, 2.0, 3.0])
        np.testing.assert_allclose(from_optitrack(v), W_from_O.apply(v), atol=1e-12)


def test_hover_thrust_carries_the_weight():
    """The weight is carried by the hover thrust, twice of it by twice that, and nothing leaves 0 to
    1."""
    assert thrust_to_px4(9.81, 0.45, 9.81) == 0.45
    assert thrust_to_px4(19.62, 0.45, 9.81) == 0.9
    assert (thrust_to_px4(99.0, 0.45, 9.81), thrust_to_px4(-1.0, 0.45, 9.81)) == (1.0, 0.0)
