import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.analysis.fidelity.study import choose_held_out, displace_pose, drop_frames


def test_withheld_stretches():
    assert choose_held_out(16, [1, 3], 2) == [2, 5, 6, 7, 10]
    assert choose_held_out(5, [1], 2) == [2]
    with pytest.raises(ValueError, match="4 frames are too few to hold out 1 between 2"):
        choose_held_out(4, [1], 2)


def test_capture_without_frames(place):
    rest = drop_frames(place.capture, [0, 2, 3])
    assert len(rest) == 13
    for k, i in ((0, 1), (1, 4), (12, 15)):
        assert rest.X_WCs[k] is place.capture.X_WCs[i]
        np.testing.assert_array_equal(rest.load_image(k), place.capture.load_image(i))
        np.testing.assert_array_equal(rest.load_depth(k), place.capture.load_depth(i))
    assert rest.has_depth


def test_displaced_poses():
    R_WC = RotationMatrix.MakeZRotation(0.3)
    path = [RigidTransform(R_WC, [1.0 * i, 2.0 * i, 0.5 * i]) for i in range(4)]
    p_WC = path[1].translation()
    left = np.array([-2, 1, 0]) / np.sqrt(5)
    expected = (0.4 * left, -0.4 * left, [0, 0, 0.4], [0, 0, -0.4])
    for X_WC, step in zip(displace_pose(path, 1, 0.4), expected, strict=True):
        np.testing.assert_allclose(X_WC.translation(), p_WC + step, atol=1e-12)
        np.testing.assert_array_equal(X_WC.rotation().matrix(), R_WC.matrix())


def test_displaced_poses_without_a_way():
    R_WC = RotationMatrix.MakeZRotation(0.3)
    climb = [RigidTransform(R_WC, [0.0, 0.0, 1.0 * i]) for i in range(3)]
    for path in (climb[:1], climb):
        left = displace_pose(path, 0, 0.5)[0].translation() - path[0].translation()
        np.testing.assert_allclose(left, -0.5 * R_WC.matrix()[:, 0], atol=1e-12)
