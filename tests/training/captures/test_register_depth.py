import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import register_depth

K_D = np.array([[58.5, 0, 32], [0, 58.5, 24], [0, 0, 1.0]])
K_C = np.array([[52.0, 0, 32], [0, 52.0, 24], [0, 0, 1.0]])


def plane_depth(n, d, K, width, height):
    """Depth (H, W) of the plane n.Q = d seen by a pinhole at the origin."""
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    return d / (rays @ n)


@pytest.mark.parametrize("finer", [1, 3])
def test_plane(finer):
    X_CD = RigidTransform(RotationMatrix.MakeYRotation(0.05), [0.024, 0.005, -0.01])
    K = np.diag([finer, finer, 1]) @ K_C
    n, d = np.array([0.2, -0.1, 1.0]), 2.0
    n_C = X_CD.rotation().multiply(n)
    d_C = d + n_C @ X_CD.translation()
    depth = plane_depth(n, d, K_D, 64, 48).astype(np.float32)
    got = register_depth(depth, K_D, X_CD, K, 64 * finer, 48 * finer)
    want = plane_depth(n_C, d_C, K, 64 * finer, 48 * finer)
    inner = np.s_[8 * finer : -8 * finer, 8 * finer : -8 * finer]
    # Half a pixel of the coarser camera on this slope.
    np.testing.assert_allclose(got[inner], want[inner], rtol=0.004)


def test_same_camera_changes_nothing():
    depth = np.random.default_rng(0).uniform(1, 5, (48, 64)).astype(np.float32)
    depth[3, 4], depth[5, 6] = 0, np.inf
    got = register_depth(depth, K_D, RigidTransform(), K_D, 64, 48)
    np.testing.assert_allclose(got, depth, rtol=1e-6)


def test_nearer_surface_hides_the_farther():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 20:30] = 1.0
    got = register_depth(depth, K_D, RigidTransform([0.3, 0, 0]), K_D, 64, 48)
    shift = 0.3 * 58.5
    covered = got[:, int(np.ceil(20 + shift)) : int(30 + shift)]
    np.testing.assert_array_equal(covered, 1.0)
