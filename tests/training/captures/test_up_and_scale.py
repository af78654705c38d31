from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.captures.capture import Capture, SfmPoints
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture, read_scene_capture
from splatpilot.training.captures.check import check_capture
from splatpilot.training.captures.up_and_scale import move_origin
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import reconstruct

FAR = np.array([456789.0, 812345.0, -283.0])  # [m]


def moved_by(capture: Capture, offset: np.ndarray) -> Capture:
    points = capture.points
    return replace(
        capture,
        X_WCs=[RigidTransform(X.rotation(), X.translation() + offset) for X in capture.X_WCs],
        points=points and SfmPoints(points.p_WQ + offset, points.colors),
    )


def write_far(write_room, path, offset=FAR):
    room = write_room(path)
    rows = np.loadtxt(room / "pose_left.txt")
    rows[:, :3] += offset * [1, -1, -1]  # north, east, down
    np.savetxt(room / "pose_left.txt", rows, fmt="%.12f")
    return room


@pytest.mark.parametrize("offset", [FAR, FAR * 10, [4180273.7, 927013.4, 4711663.3]])
def test_far_capture_is_moved_to_the_origin(write_room, tmp_path, offset):
    near = read_capture(write_room(tmp_path / "near"))
    far = read_capture(write_far(write_room, tmp_path / "far", np.array(offset)))
    assert not near.origin.any()
    for X, Y in zip(near.X_WCs, far.X_WCs, strict=True):
        p = X.translation() + offset - far.origin
        np.testing.assert_allclose(Y.translation(), p, atol=1e-8)
        assert np.linalg.norm(p) < 10
        np.testing.assert_allclose(X.rotation().matrix(), Y.rotation().matrix(), atol=1e-9)
    assert any("positions are relative to" in note for note in far.notes)


def test_points_move_with_the_cameras():
    capture = Capture(
        "a", "a", np.eye(3), 1, 1, [RigidTransform(FAR), RigidTransform(FAR + 2)],
        lambda i: np.zeros((1, 1, 3), np.uint8), points=SfmPoints(FAR + np.eye(3), np.eye(3)),
    )  # fmt: skip
    moved = move_origin(capture, [])
    assert moved.points is not None
    np.testing.assert_array_equal(moved.origin + moved.points.p_WQ, FAR + np.eye(3))


@pytest.mark.parametrize("origin", [[], [0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
def test_given_origin_is_taken(write_room, tmp_path, origin):
    room = write_far(write_room, tmp_path / "room", np.array([2000.0, 0, 0]))
    capture = read_capture(room, CaptureConfig(origin=origin))
    given = origin or [2003.0, 0.0, 1.0]
    np.testing.assert_allclose(capture.origin, given, atol=1.5)
    position = capture.X_WCs[0].translation() + capture.origin
    np.testing.assert_allclose(position, [2001, 0, 1.2], atol=1.5)


def test_far_poses_are_checked_where_the_files_have_them(write_room, tmp_path):
    poses = [((0.8 + 0.3 * i, 0.1 * i, -1.2), 0.1 * i - 0.3, -0.05 * i) for i in range(8)]
    room = write_room(tmp_path / "room", width=160, height=120, poses=poses)
    capture = moved_by(read_capture(room), FAR)
    assert capture.axes is not None
    R_WF, R_BC = RigidTransform(capture.axes.R_WF), RigidTransform(capture.axes.R_BC)
    inverse = [R_WF @ (R_BC @ X.inverse() @ R_WF) @ R_BC for X in capture.X_WCs]
    moved = move_origin(replace(capture, X_WCs=inverse), [])
    assert moved.origin.any()
    assert "poses are world to camera" in check_capture(moved).problem


def test_scene_of_a_far_capture_keeps_its_origin(write_room, tmp_path):
    room = write_far(write_room, tmp_path / "room")
    summary = reconstruct(
        read_capture(room), tmp_path / "scene", ReconstructConfig(iterations=0, voxel_size=0.1)
    )
    assert "positions are relative to" in str(summary)
    metadata = read_scene_metadata(tmp_path / "scene")
    np.testing.assert_allclose(metadata.origin, FAR, atol=10)
    assert np.abs(metadata.p_WS).max() < 10
    again = read_scene_capture(tmp_path / "scene", metadata)
    np.testing.assert_array_equal(again.origin, metadata.origin)
    assert metadata.capture_notes[0].startswith("intrinsics: fx ")
