import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.ros import TransformTree


def turned(angle: float, x: float = 0.0) -> RigidTransform:
    return RigidTransform(RotationMatrix.MakeZRotation(angle), [x, 0, 0])


def test_poses_are_composed_and_interpolated():
    tree = TransformTree()
    tree.fix("body", "camera", turned(0.0, 1.0))
    tree.move("map", "body", 10.1, turned(0.4, 4.0))
    tree.move("map", "body", 10.0, turned(0.2, 2.0))
    pose = tree.pose("camera", 10.05)
    assert pose is not None and pose.IsNearlyEqualTo(turned(0.3, 3.0) @ turned(0.0, 1.0), 1e-9)
    exact = tree.pose("camera", 10.1)
    assert exact is not None and exact.IsNearlyEqualTo(turned(0.4, 4.0) @ turned(0.0, 1.0), 1e-12)
    tree.move("map", "body", 10.2, turned(0.4, 5.0))
    later = tree.pose("body", 10.15)
    assert later is not None and np.isclose(later.translation()[0], 4.5)


def test_what_is_not_known():
    tree = TransformTree()
    for time in (1.0, 2.0):
        tree.move("map", "body", time, turned(0.0))
    assert tree.pose("body", 0.5) is None and tree.pose("body", 1.5) is None
    alone = tree.pose("lamp", 1.0)
    assert alone is not None and alone.IsNearlyEqualTo(RigidTransform(), 0)
    tree.fix("b", "a", turned(0.0))
    tree.fix("a", "b", turned(0.0))
    assert tree.pose("a", 1.0) is None


def test_fixed_poses():
    tree = TransformTree()
    tree.fix("body", "mast", turned(0.1, 1.0))
    tree.fix("mast", "camera", turned(0.1, 1.0))
    tree.move("map", "body", 1.0, turned(0.0))
    found = tree.fixed_pose("body", "camera")
    assert found is not None and found.IsNearlyEqualTo(turned(0.1, 1.0) @ turned(0.1, 1.0), 1e-12)
    assert tree.fixed_pose("map", "camera") is None and tree.fixed_pose("lamp", "camera") is None
    own = tree.fixed_pose("camera", "camera")
    assert own is not None and own.IsNearlyEqualTo(RigidTransform(), 0)
