from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from room import write_room_capture

from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.training.captures.capture import SfmPoints
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture, read_scene_capture
from splatpilot.training.captures.check import check_capture
from splatpilot.training.captures.up_and_scale import move_origin
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import reconstruct

FAR = np.array([456789.0, 812345.0, -283.0])  # [m]


def write_far(path, offset=FAR):
    room = write_room_capture(path)
    rows = np.loadtxt(room / "pose_left.txt")
    rows[:, :3] += offset * [1, -1, -1]  # north, east, down
    np.savetxt(room / "pose_left.txt", rows, fmt="%.12f")
    return room


@pytest.mark.parametrize("offset", [FAR, FAR * 10, [4180273.7, 927013.4, 4711663.3]])
def test_far_capture_is_moved_to_the_origin(tmp_path, offset):
    near = read_capture(write_room_capture(tmp_path / "near"))
    far = read_capture(write_far(tmp_path / "far", np.array(offset)))
    assert not near.origin.any()
    for X, Y in zip(near.X_WCs, far.X_WCs, strict=True):
        p = X.translation() + offset - far.origin
        np.testing.assert_allclose(Y.translation(), p, atol=1e-8)
        assert np.linalg.norm(p) < 10
        np.testing.assert_allclose(X.rotation().matrix(), Y.rotation().matrix(), atol=1e-9)
    assert any("positions are relative to" in note for note in far.notes)


@pytest.mark.parametrize("origin", [[], [0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
def test_given_origin_is_taken(tmp_path, origin):
    room = write_far(tmp_path / "room", np.array([2000.0, 0, 0]))
    capture = read_capture(room, CaptureConfig(origin=origin))
    given = origin or [2003.0, 0.0, 1.0]
    np.testing.assert_allclose(capture.origin, given, atol=1.5)
    position = capture.X_WCs[0].translation() + capture.origin
    np.testing.assert_allclose(position, [2001, 0, 1.2], atol=1.5)


def test_far_poses_are_checked_where_the_files_have_them(tmp_path):
    poses = [((0.8 + 0.3 * i, 0.1 * i, -1.2), 0.1 * i - 0.3, -0.05 * i) for i in range(8)]
    room = write_room_capture(tmp_path / "room", width=160, height=120, poses=poses)
    capture, move = read_capture(room), RigidTransform(FAR)
    R_WF, R_BC = RigidTransform(capture.axes.R_WF), RigidTransform(capture.axes.R_BC)
    inverse = [R_WF @ (R_BC @ (move @ X).inverse() @ R_WF) @ R_BC for X in capture.X_WCs]
    points = SfmPoints(FAR + np.eye(3), np.eye(3))
    moved = move_origin(replace(capture, X_WCs=inverse, points=points), [])
    assert moved.origin.any()
    np.testing.assert_array_equal(moved.origin + moved.points.p_WQ, FAR + np.eye(3))
    assert "poses are world to camera" in check_capture(moved).problem


def test_scene_of_a_far_capture_keeps_its_origin(tmp_path):
    scene, config = tmp_path / "scene", ReconstructConfig(iterations=0, voxel_size=0.4)
    summary = reconstruct(read_capture(write_far(tmp_path / "room")), scene, config)
    assert "positions are relative to" in str(summary)
    metadata = read_scene_metadata(scene)
    np.testing.assert_allclose(metadata.origin, FAR, atol=10)
    assert np.abs(metadata.p_WS).max() < 10
    again = read_scene_capture(scene, metadata)
    np.testing.assert_array_equal(again.origin, metadata.origin)
    assert metadata.capture_notes[0].startswith("intrinsics: fx ")
