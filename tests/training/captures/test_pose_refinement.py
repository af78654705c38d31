import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.frame_comparison import ComparedFrame
from splatpilot.training.captures.refine_poses import refine_poses

K = np.array([[300.0, 0, 162.0], [0, 304.0, 118.0], [0, 0, 1]])


@pytest.fixture
def frames(room_views):
    """Returns the room as compared from poses, with noise of so much in depth."""

    def views(poses: list[RigidTransform], noise: float = 0.0) -> list[ComparedFrame]:
        rng = np.random.default_rng(5)
        return [
            ComparedFrame.of(
                CaptureFrame(
                    view.image,
                    (view.depth * (1 + noise * rng.standard_normal(view.depth.shape))).astype(
                        np.float32
                    ),
                    view.X_WC,
                    K,
                )
            )
            for view in room_views(K, 320, 240, poses, finer=8.0)
        ]

    return views


def drifting(poses: list[RigidTransform], turned: float, moved: float) -> list[RigidTransform]:
    """Adds a random walk that ends about so far off [rad], [m]."""
    walk = np.random.default_rng(1).standard_normal((len(poses), 6)).cumsum(axis=0)
    walk *= np.repeat([turned, moved], 3) / np.sqrt(len(poses))
    return [
        RigidTransform(
            RotationMatrix(Rotation.from_rotvec(step[:3]).as_matrix()) @ X_WC.rotation(),
            X_WC.translation() + step[3:],
        )
        for step, X_WC in zip(walk, poses, strict=True)
    ]


def errors(poses: list[RigidTransform], truth: list[RigidTransform]) -> np.ndarray:
    """Root mean square of what is wrong between each pose and the next, turned [rad] and moved
    [m]: the place as a whole may lie anywhere."""
    wrong = [
        (a.inverse() @ b).inverse() @ (c.inverse() @ d)
        for a, b, c, d in zip(poses, poses[1:], truth, truth[1:], strict=False)
    ]
    return np.array(
        [
            np.sqrt(np.mean([X.rotation().ToAngleAxis().angle() ** 2 for X in wrong])),
            np.sqrt(np.mean([X.translation() @ X.translation() for X in wrong])),
        ]
    )


@pytest.mark.parametrize(("noise", "left"), [(0.0, 0.1), (0.005, 0.3)])
def test_drift_is_mended(frames, room_poses, noise, left):
    given = drifting(room_poses, 0.02, 0.02)
    refined = refine_poses(frames(room_poses, noise), given)
    assert (errors(refined.X_WCs, room_poses) < left * errors(given, room_poses)).all()
    assert refined.contrast[1] < refined.contrast[0]
    assert refined.depth[1] < refined.depth[0]
    assert refined.moved > 0.001
    assert "poses moved by" in str(refined)


def test_exact_poses_stay(frames, room_poses):
    refined = refine_poses(frames(room_poses), room_poses)
    turned, moved = errors(refined.X_WCs, room_poses)
    assert turned < 1e-3
    assert moved < 1e-3


def test_who_sees_nothing_goes_with_its_neighbours(frames, room_poses):
    given = drifting(room_poses, 0.02, 0.02)
    seen = frames(room_poses)
    blind = CaptureFrame(
        np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32), given[5], K
    )
    seen[5] = ComparedFrame.of(blind)
    refined = refine_poses(seen, given).X_WCs
    before, own, after = (refined[i].translation() - given[i].translation() for i in (4, 5, 6))
    np.testing.assert_allclose(own, (before + after) / 2, atol=1e-3)
    others = [i for i in range(len(given)) if i != 5]
    left = errors([refined[i] for i in others], [room_poses[i] for i in others])
    assert (left < 0.1 * errors(given, room_poses)).all()


def test_nothing_in_common(frames, room_poses):
    X_WC = room_poses[0]
    behind = X_WC @ RigidTransform(RotationMatrix.MakeYRotation(np.pi), [0, 0, 0])
    with pytest.raises(ValueError, match="no two frames see the same"):
        refine_poses(frames([X_WC, behind]), [X_WC, behind])
