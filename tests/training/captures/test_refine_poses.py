import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import CAMERA_POSES, room_views
from scipy.spatial.transform import Rotation

from splatpilot.training.captures import refine_poses as module
from splatpilot.training.captures.capture import CaptureFrame, pinhole
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.refine_poses import ComparedFrame, compare_frames, refine_poses

K = pinhole(300.0, 304.0, 162.0, 118.0)


def frames(poses, noise: float = 0.0, exposure: float = 1.0) -> list[ComparedFrame]:
    rng = np.random.default_rng(5)
    prepared = []
    for i, view in enumerate(room_views(K, 320, 240, poses, finer=8.0)):
        image = np.clip(view.image * exposure**i, 0, 255).astype(np.uint8)
        depth = view.depth * (1 + noise * rng.standard_normal(view.depth.shape))
        frame = CaptureFrame(image, depth.astype(np.float32), view.X_WC, K)
        prepared.append(ComparedFrame.prepare(frame))
    return prepared


def moved(X_WC: RigidTransform, step: np.ndarray) -> RigidTransform:
    R = RotationMatrix(Rotation.from_rotvec(step[:3]).as_matrix())
    return RigidTransform(R @ X_WC.rotation(), X_WC.translation() + step[3:])


def drifting(poses: list[RigidTransform], rotation: float, shift: float) -> list[RigidTransform]:
    walk = np.random.default_rng(1).standard_normal((len(poses), 6)).cumsum(axis=0)
    walk *= np.repeat([rotation, shift], 3) / np.sqrt(len(poses))
    return [moved(X_WC, step) for step, X_WC in zip(walk, poses, strict=True)]


def errors(poses: list[RigidTransform], truth: list[RigidTransform]) -> np.ndarray:
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


def test_derivatives():
    given = CAMERA_POSES[5:7]
    seen, h = frames(given), 1e-4
    for number in range(12):

        def at(step: float, number=number) -> np.ndarray:
            by = np.zeros((2, 6))
            by.flat[number] = step
            X_WCs = [moved(X, each) for X, each in zip(given, by, strict=True)]
            return compare_frames(*seen, *X_WCs, 0.08)

        expected = (at(h).residuals - at(-h).residuals) / (2 * h)
        found = at(0.0).derivatives[..., number]
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


@pytest.mark.parametrize(("noise", "left"), [(0.0, 0.1), (0.005, 0.3)])
def test_drift_is_removed(noise, left):
    given = drifting(CAMERA_POSES, 0.02, 0.02)
    refined = refine_poses(frames(CAMERA_POSES, noise, exposure=0.97), given)
    assert (errors(refined.X_WCs, CAMERA_POSES) < left * errors(given, CAMERA_POSES)).all()
    assert refined.contrast[1] < refined.contrast[0]
    assert refined.depth[1] < refined.depth[0]
    assert refined.moved > 0.001
    assert "poses moved by" in str(refined)


def test_blind_frame_moves_with_its_neighbors():
    given = drifting(CAMERA_POSES, 0.02, 0.02)
    seen = frames(CAMERA_POSES)
    blind = CaptureFrame(
        np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32), given[5], K
    )
    seen[5] = ComparedFrame.prepare(blind)
    refined = refine_poses(seen, given).X_WCs
    before, own, after = (refined[i].translation() - given[i].translation() for i in (4, 5, 6))
    np.testing.assert_allclose(own, (before + after) / 2, atol=1e-3)
    others = [i for i in range(len(given)) if i != 5]
    left = errors([refined[i] for i in others], [CAMERA_POSES[i] for i in others])
    assert (left < 0.1 * errors(given, CAMERA_POSES)).all()


@pytest.fixture
def folder(tmp_path) -> Path:
    path = tmp_path / "capture"
    path.mkdir()
    (path / "capture.yaml").write_text(
        "intrinsics: [300, 304, 162, 118]\ndepth_intrinsics: [300, 304, 162, 118]\n"
        f"p_DC: [0, 0, 0]\nup: z\nrefine_poses: true\ncache: {tmp_path / 'cache'}\n"
    )
    for i, view in enumerate(room_views(K, 320, 240, finer=8.0)):
        stem = path / f"frame-{i:06d}"
        cv2.imwrite(f"{stem}.color.png", view.image[..., ::-1])
        cv2.imwrite(f"{stem}.depth.png", np.round(1000 * view.depth).astype(np.uint16))
        off = RigidTransform([0.01 * np.sin(2 * i), 0, 0])
        np.savetxt(f"{stem}.pose.txt", (off @ CAMERA_POSES[i]).GetAsMatrix4())
    return path


def test_poses_are_refined_once(folder, monkeypatch, capfd):
    capture = read_capture(folder)
    assert "poses moved by" in capfd.readouterr().err
    assert errors(capture.X_WCs, CAMERA_POSES)[1] < 0.003  # of 0.012
    monkeypatch.setattr(module, "refine_poses", None)
    again = read_capture(folder)
    for X_WC, same in zip(capture.X_WCs, again.X_WCs, strict=True):
        assert X_WC.IsExactlyEqualTo(same)
    assert capfd.readouterr().err == ""
    with pytest.raises(TypeError):  # it would refine them again
        read_capture(folder, CaptureConfig(depth_unit=500.0))
    (folder / "frame-000003.depth.png").touch()
    with pytest.raises(TypeError):
        read_capture(folder)


def test_frames_without_overlap_are_refused(folder):
    for file in folder.glob("*.pose.txt"):
        np.savetxt(file, np.loadtxt(file) * [1, 1, 1, 100] + np.diag([0, 0, 0, -99]))
    with pytest.raises(ValueError, match="capture: no two frames see the same"):
        read_capture(folder)


def test_without_depth(tmp_path):
    path = tmp_path / "nerfstudio"
    path.mkdir()
    cv2.imwrite(str(path / "0.png"), np.zeros((240, 320, 3), np.uint8))
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    camera = {"fl_x": 300, "fl_y": 300, "cx": 160, "cy": 120, "w": 320, "h": 240}
    (path / "transforms.json").write_text(json.dumps(camera | {"frames": [frame, frame]}))
    with pytest.raises(ValueError, match=r"nerfstudio: .* needs depth"):
        read_capture(path, CaptureConfig(refine_poses=True, cache=str(tmp_path / "cache")))
    assert not (tmp_path / "cache").exists()


def test_exact_poses_stay():
    refined = refine_poses(frames(CAMERA_POSES), CAMERA_POSES)
    assert (errors(refined.X_WCs, CAMERA_POSES) < 1e-3).all()
