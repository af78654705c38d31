"""Poses between two others."""

from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.vehicle.state import pose_between


def test_poses_between():
    """Half of the way is half of the turn about the same axis, and half of the distance."""
    X_0 = RigidTransform(RotationMatrix.MakeZRotation(0.4), [1.0, 0, 0])
    X_1 = RigidTransform(RotationMatrix.MakeZRotation(1.0), [3.0, 2, 0])
    expected = RigidTransform(RotationMatrix.MakeZRotation(0.7), [2.0, 1, 0])
    assert pose_between(X_0, X_1, 0.5).IsNearlyEqualTo(expected, 1e-12)
    assert pose_between(X_0, X_1, 0.0).IsNearlyEqualTo(X_0, 1e-12)
    assert pose_between(X_0, X_1, 1.0).IsNearlyEqualTo(X_1, 1e-12)
    assert pose_between(X_0, X_0, 0.3).IsNearlyEqualTo(X_0, 1e-12)
