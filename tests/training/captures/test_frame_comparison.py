import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.refine_poses import ComparedFrame, compare_frames

K = np.array([[300.0, 0, 162.0], [0, 304.0, 118.0], [0, 0, 1]])


@pytest.fixture
def seen(room_views):
    """Returns what is compared of the room, seen from a pose and exposed somehow."""

    def view(X_WC: RigidTransform, exposure: float = 1.0) -> ComparedFrame:
        (room,) = room_views(K, 320, 240, [X_WC], finer=8.0)
        image = np.clip(room.image * exposure, 0, 255).astype(np.uint8)
        return ComparedFrame.prepare(CaptureFrame(image, room.depth.astype(np.float32), X_WC, K))

    return view


def test_true_poses_leave_no_difference(seen, room_poses):
    X_WC, X_WC_other = room_poses[2:4]
    found = compare_frames(seen(X_WC), seen(X_WC_other, 0.67), X_WC, X_WC_other, 0.04)
    assert found is not None
    depth, contrast = np.median(np.abs(found.residuals), axis=1)
    assert depth < 1e-4
    assert contrast < 0.05


@pytest.mark.parametrize("number", range(12))
def test_derivatives(seen, room_poses, number):
    X_WC, X_WC_other = room_poses[5:7]
    frames = seen(X_WC), seen(X_WC_other)

    def at(step: float) -> tuple[RigidTransform, RigidTransform]:
        by = np.zeros((2, 6))
        by.flat[number] = step
        return tuple(
            RigidTransform(
                RotationMatrix(Rotation.from_rotvec(w).as_matrix()) @ X.rotation(),
                X.translation() + t,
            )
            for X, w, t in zip((X_WC, X_WC_other), by[:, :3], by[:, 3:], strict=True)
        )

    h = 1e-4
    less, here, more = (compare_frames(*frames, *at(step), 0.08) for step in (-h, 0.0, h))
    assert less is not None and here is not None and more is not None
    expected = (more.residuals - less.residuals) / (2 * h)
    found = here.derivatives[..., number]
    # Slopes are those over two pixels, which is less where colors turn: most points, about.
    error = np.abs(found - expected) / (np.abs(expected).max(axis=1, keepdims=True) + 1e-6)
    assert (np.median(error, axis=1) < [0.001, 0.1]).all()


def test_edges_and_holes_are_not_compared():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 40:] = 3.0
    depth[20, 10] = 0
    depth[:10] = np.inf
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    frame = ComparedFrame.prepare(CaptureFrame(image, depth, RigidTransform(), K))
    known = frame.inverse_depth > 0
    assert not known[:12].any()
    assert not known[:, 38:42].any()
    assert not known[18:23, 8:13].any()
    assert known[14, 20]
    np.testing.assert_allclose(frame.inverse_depth[30, [20, 50]], [1 / 2, 1 / 3], rtol=1e-6)
    away = np.array([[0.0, 0, -1.0], [9.0, 0, 1.0]])
    assert not frame.sees(away)[0].any()


def test_too_few_in_common(seen, room_poses):
    X_WC = room_poses[0]
    behind = X_WC @ RigidTransform(RotationMatrix.MakeYRotation(np.pi), [0, 0, 0])
    assert compare_frames(seen(X_WC), seen(behind), X_WC, behind, 0.08) is None
