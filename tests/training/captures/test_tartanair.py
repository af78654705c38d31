from pathlib import Path

import cv2
import numpy as np
import pytest
from room import LOWER_W, UPPER_W, room_color, write_room_capture

from splatpilot.training.captures.capture import back_project
from splatpilot.training.captures.capture_registry import read_capture


@pytest.fixture
def room(tmp_path) -> Path:
    return write_room_capture(tmp_path / "room")


def test_world_is_north_west_up(room):
    capture = read_capture(room)
    assert (len(capture), capture.width, capture.height, capture.name) == (12, 64, 48, "room")
    np.testing.assert_array_equal(capture.K, [[32, 0, 32], [0, 32, 24], [0, 0, 1]])
    v, u = np.mgrid[0:48, 0:64] + 0.5
    for frame in capture.frames():
        p_CQ = back_project(frame.K, u, v, frame.depth.astype(float))
        p_W = frame.X_WC.multiply(p_CQ.reshape(-1, 3).T).T.reshape(48, 64, 3)
        assert np.abs(np.minimum(p_W - LOWER_W, UPPER_W - p_W).min(axis=-1)).max() < 1e-5
        color = room_color(p_W * [1, -1, -1])
        np.testing.assert_allclose(frame.image / 255, color, atol=0.5 / 255 + 1e-4)
    optical = [[0, 0, 1, 0.8], [-1, 0, 0, 0], [0, -1, 0, 1.1]]
    np.testing.assert_allclose(capture.X_WCs[0].GetAsMatrix34(), optical, atol=1e-8)


def test_frames_are_loaded_on_demand(room):
    bad = room / "image_left" / "000007_left.png"
    capture = read_capture(room)
    bad.write_bytes(b"no image any more")
    capture.frame(6)
    with pytest.raises(ValueError, match=r"000007_left\.png: not a readable image"):
        capture.frame(7)
    with pytest.raises(IndexError, match=r"frame 12 of room: .* 0 to 11"):
        capture.frame(12)


def test_invalid_depth_is_unknown(room):
    file = room / "depth_left" / "000000_left_depth.npy"
    depth = np.load(file)
    depth[0, :3] = [np.nan, -1, np.inf]
    np.save(file, depth)
    found = read_capture(room).frame(0).depth[0, :4]
    np.testing.assert_array_equal(found, [0, 0, np.inf, depth[0, 3]])


def test_poses_stay_with_their_frames_if_files_are_missing(room):
    images, depths = room / "image_left", room / "depth_left"
    extra = depths / "000012_left_depth.npy"
    extra.write_bytes((depths / "000011_left_depth.npy").read_bytes())
    whole = read_capture(room)
    assert len(whole) == 12 and "000012_left_depth.npy: has no image" in whole.dropped[0]
    extra.unlink()
    (images / "000003_left.png").unlink()
    (depths / "000008_left_depth.npy").unlink()
    capture = read_capture(room)
    assert len(capture) == 10 and len(capture.dropped) == 2
    assert "000003_left.png" in capture.dropped[0]
    assert "000008_left_depth.npy" in capture.dropped[1]
    assert capture.frame_names[3] == "000004_left.png"
    assert capture.X_WCs[3].IsExactlyEqualTo(whole.X_WCs[4])


def change_line_5(room: Path, *lines: str) -> None:
    file = room / "pose_left.txt"
    every = file.read_text().splitlines()
    file.write_text("\n".join([*every[:4], *lines, *every[5:]]))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda room: (room / "depth_left").rename(room / "moved"), "No such folder: .*depth_left"),
        (lambda room: (room / "pose_left.txt").unlink(), "No such file: .*pose_left.txt"),
        (lambda room: [file.unlink() for file in (room / "image_left").iterdir()],
         "image_left: holds no file named like"),
        (change_line_5, r"pose_left\.txt: 11 poses for 12 images and 12 dep"),
        (lambda room: change_line_5(room, "0 0 0 0 0 0"),
         r"pose_left\.txt, line 5 must be a pose tx ty tz"),
    ],
)  # fmt: skip
def test_damaged_sequence_is_refused(room, damage, message):
    damage(room)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_capture(room)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 0 nan 0 0 0 1", "the pose is not finite"),
        ("0 0 0 0 0 0 1.1", "the quaternion must be 1 +- 0.001, got 1.1"),
        ("3e8 0 0 0 0 0 1", "must be within 1e+08 m"),
    ],
)
def test_frame_of_an_invalid_pose_is_left_out(room, line, message):
    change_line_5(room, line)
    capture = read_capture(room)
    assert len(capture) == 11 and len(capture.dropped) == 1
    assert "pose_left.txt, line 5: " in capture.dropped[0] and message in capture.dropped[0]


def test_v2(tmp_path, room):
    v2 = tmp_path / "P000"
    for file in room.rglob("*.*"):
        copy = v2 / str(file.relative_to(room)).replace("left", "lcam_front")
        copy.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".npy":
            packed = np.load(file).astype("<f4")[..., None].view(np.uint8)
            cv2.imwrite(str(copy.with_suffix(".png")), packed)
        else:
            copy.write_bytes(file.read_bytes())
    one, two = read_capture(room), read_capture(v2)
    assert len(two) == 12 and two.source.startswith("TartanAir V2")
    for i in (0, 7):
        np.testing.assert_array_equal(one.frame(i).image, two.frame(i).image)
        np.testing.assert_array_equal(one.frame(i).depth, two.frame(i).depth)
        assert one.X_WCs[i].IsExactlyEqualTo(two.X_WCs[i])
    np.testing.assert_array_equal(one.K, two.K)
