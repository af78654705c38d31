"""Poses between two others."""

from pydrake.math import RigidTransform, RotationMatrix


def pose_between(X_WC0: RigidTransform, X_WC1: RigidTransform, s: float) -> RigidTransform:
    """The pose at the fraction s of the way from X_WC0 to X_WC1: along the line between the
    positions, and turned about one axis."""
    turn = (X_WC0.rotation().inverse() @ X_WC1.rotation()).ToAngleAxis()
    turn.set_angle(s * turn.angle())
    p_WC = (1.0 - s) * X_WC0.translation() + s * X_WC1.translation()
    return RigidTransform(X_WC0.rotation() @ RotationMatrix(turn), p_WC)
