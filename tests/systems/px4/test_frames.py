"""Frames, against other implementations of rotations."""

import numpy as np
import pytest
from pymavlink.quaternion import Quaternion
from pymavlink.rotmat import Vector3
from scipy.spatial.transform import Rotation

from splatpilot.systems.px4.mavlink import pose_from_optitrack, swap_px4, thrust_to_px4

NED_FROM_W = Rotation.from_euler("x", 180, degrees=True)
W_FROM_O = Rotation.from_euler("x", 90, degrees=True)
ATTITUDES = Rotation.random(20, random_state=0)
VECTORS = np.random.default_rng(0).normal(size=(10, 3))


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def assert_same_attitude(q: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(q * np.sign(q.dot(expected)), expected, atol=1e-12)


def test_vectors_are_rotated_as_scipy_rotates_them():
    for v in VECTORS:
        np.testing.assert_allclose(swap_px4(v), NED_FROM_W.apply(v), atol=1e-12)
        np.testing.assert_array_equal(swap_px4(swap_px4(v)), v)
    np.testing.assert_array_equal(swap_px4(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_attitudes_are_those_of_scipy_and_of_pymavlink():
    for R_WB in ATTITUDES:
        q = swap_px4(wxyz(R_WB))
        assert_same_attitude(q, wxyz(NED_FROM_W * R_WB * NED_FROM_W.inv()))
        dcm = Quaternion(q).dcm
        forward, left = R_WB.apply([1.0, 0, 0]), R_WB.apply([0.0, 1, 0])
        for axis, ours in ((Vector3(1, 0, 0), forward), (Vector3(0, 1, 0), -left)):
            pointed = dcm * axis
            found = [pointed.x, pointed.y, pointed.z]
            np.testing.assert_allclose(found, NED_FROM_W.apply(ours), atol=1e-6)


def test_optitracks_poses_are_those_of_scipy_and_px4s_recipe():
    for R_OR, v in zip(ATTITUDES, np.vstack([VECTORS, VECTORS]), strict=True):
        pose = pose_from_optitrack(v, R_OR.as_quat())
        np.testing.assert_allclose(pose[:3], W_FROM_O.apply(v), atol=1e-12)
        assert_same_attitude(pose[3:], wxyz(W_FROM_O * R_OR * W_FROM_O.inv()))
        np.testing.assert_allclose(swap_px4(pose[:3]), [v[0], v[2], -v[1]])
        x, y, z, w = R_OR.as_quat()
        np.testing.assert_allclose(swap_px4(pose[3:]), [w, x, z, -y])


@pytest.mark.parametrize(("thrust", "px4"), [(9.81, 0.45), (19.62, 0.9), (99.0, 1.0), (-1.0, 0.0)])
def test_hover_thrust_carries_the_weight(thrust, px4):
    assert thrust_to_px4(thrust, 0.45, 9.81) == px4
