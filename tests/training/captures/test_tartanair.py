import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.training.captures.tartanair import (
    read_tartanair_v1,
    read_tartanair_v2,
    recognizes_tartanair_v1,
    recognizes_tartanair_v2,
)


def back_projected(frame) -> np.ndarray:
    """World points (H, W, 3) of all pixels."""
    height, width = frame.depth.shape
    rows, columns = np.mgrid[0:height, 0:width]
    p_CQ = frame.back_project(columns + 0.5, rows + 0.5, frame.depth.astype(float))
    return frame.X_WC.multiply(p_CQ.reshape(-1, 3).T).T.reshape(height, width, 3)


def test_world_is_north_west_up(tmp_path, write_room, room_in_W):
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    assert (len(capture), capture.width, capture.height, capture.name) == (12, 64, 48, "room")
    lower, upper = room_in_W
    for frame in capture.frames():
        p_W = back_projected(frame)
        to_wall = np.minimum(np.abs(p_W - lower), np.abs(p_W - upper)).min(axis=-1)
        assert to_wall.max() < 1e-5
        assert (p_W > lower - 1e-5).all() and (p_W < upper + 1e-5).all()


def test_first_pose_by_hand(tmp_path, write_room):
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    X_WC = capture.frame(0).X_WC
    np.testing.assert_allclose(X_WC.translation(), [0.8, 0, 1.1], atol=1e-9)
    np.testing.assert_allclose(
        X_WC.rotation().matrix(), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-8
    )


def test_colors_belong_to_the_points(tmp_path, write_room, color_of_room):
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    frame = capture.frame(5)
    p_N = back_projected(frame) * [1, -1, -1]
    assert frame.image.dtype == np.uint8
    np.testing.assert_allclose(frame.image / 255, color_of_room(p_N), atol=0.5 / 255 + 1e-4)


def test_intrinsics_scale_with_the_image(tmp_path, write_room):
    capture = read_tartanair_v1(write_room(tmp_path / "room", width=80, height=60))
    np.testing.assert_array_equal(capture.K, [[40, 0, 40], [0, 40, 30], [0, 0, 1]])


def test_frames_are_loaded_when_asked_for(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    bad = room / "image_left" / "000007_left.png"
    capture = read_tartanair_v1(room)
    bad.write_bytes(b"no image any more")
    capture.frame(6)
    with pytest.raises(ValueError, match=r"000007_left\.png: not a readable image"):
        capture.frame(7)
    with pytest.raises(IndexError, match=r"frame 12 of room: .* 0 to 11"):
        capture.frame(12)


def test_invalid_depth_is_unknown(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    file = room / "depth_left" / "000000_left_depth.npy"
    depth = np.load(file)
    depth[0, :3] = [np.nan, -1, np.inf]
    np.save(file, depth)
    np.testing.assert_array_equal(
        read_tartanair_v1(room).frame(0).depth[0, :4], [0, 0, np.inf, depth[0, 3]]
    )


@pytest.mark.parametrize("part", ["image_left", "depth_left", "pose_left.txt"])
def test_missing_part(tmp_path, write_room, part):
    room = write_room(tmp_path / "room")
    (room / part).rename(room / "elsewhere")
    with pytest.raises(FileNotFoundError, match=part):
        read_tartanair_v1(room)


def test_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No such folder: .*nowhere"):
        read_tartanair_v1(tmp_path / "nowhere")
    assert not recognizes_tartanair_v1(tmp_path / "nowhere")


def test_empty_image_folder(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    for file in (room / "image_left").iterdir():
        file.unlink()
    with pytest.raises(FileNotFoundError, match="image_left: holds no file named like"):
        read_tartanair_v1(room)


def test_missing_file_of_a_frame(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    whole = read_tartanair_v1(room)
    (room / "image_left" / "000003_left.png").unlink()
    (room / "depth_left" / "000008_left_depth.npy").unlink()
    capture = read_tartanair_v1(room)
    assert len(capture) == 10 and len(capture.dropped) == 2
    assert "000003_left.png" in capture.dropped[0]
    assert "000008_left_depth.npy" in capture.dropped[1]
    assert capture.frame_names[3] == "000004_left.png"
    assert capture.X_WCs[3].IsExactlyEqualTo(whole.X_WCs[4])


def test_extra_depth(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    depth = room / "depth_left" / "000012_left_depth.npy"
    depth.write_bytes((room / "depth_left" / "000011_left_depth.npy").read_bytes())
    capture = read_tartanair_v1(room)
    assert len(capture) == 12 and "000012_left_depth.npy: has no image" in capture.dropped[0]


@pytest.mark.parametrize("change", [lambda lines: lines[:-1], lambda lines: [*lines, lines[0]]])
def test_other_number_of_poses(tmp_path, write_room, change):
    room = write_room(tmp_path / "room")
    lines = change((room / "pose_left.txt").read_text().splitlines())
    (room / "pose_left.txt").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"pose_left\.txt: 1[13] poses for 12 images and 12 dep"):
        read_tartanair_v1(room)


def spoilt_line(room, line):
    lines = (room / "pose_left.txt").read_text().splitlines()
    lines[4] = line
    (room / "pose_left.txt").write_text("\n".join(lines))


@pytest.mark.parametrize("line", ["0 0 0 0 0 0", "a b c d e f g", ""])
def test_line_that_is_no_pose(tmp_path, write_room, line):
    room = write_room(tmp_path / "room")
    spoilt_line(room, line)
    with pytest.raises(ValueError, match=r"pose_left\.txt, line 5 must be a pose tx ty tz"):
        read_tartanair_v1(room)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 0 nan 0 0 0 1", "the pose is not finite"),
        ("0 0 0 0 0 0 1.1", "the quaternion must be 1 +- 0.001, got 1.1"),
        ("0 0 0 0 0 0 0", "the quaternion must be 1 +- 0.001, got 0"),
        ("0 0 0 nan 0 0 1", "the pose is not finite"),
        ("3e8 0 0 0 0 0 1", "must be within 1e+08 m"),
    ],
)
def test_absurd_pose(tmp_path, write_room, line, message):
    room = write_room(tmp_path / "room")
    spoilt_line(room, line)
    capture = read_tartanair_v1(room)
    assert len(capture) == 11 and len(capture.dropped) == 1
    assert "pose_left.txt, line 5: " in capture.dropped[0] and message in capture.dropped[0]


@pytest.mark.parametrize("file", ["image_left/000002_left.png", "depth_left/000002_left_depth.npy"])
@pytest.mark.parametrize("keep", [0, 20])
def test_empty_or_cut_file(tmp_path, write_room, file, keep):
    room = write_room(tmp_path / "room")
    (room / file).write_bytes((room / file).read_bytes()[:keep])
    capture = read_tartanair_v1(room)
    assert len(capture) == 11
    assert (
        f"{Path(file).name}: {'not a readable' if keep else 'the file is empty'}"
        in (capture.dropped[0])
    )


def test_other_size(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    np.save(room / "depth_left" / "000001_left_depth.npy", np.ones((24, 32), np.float32))
    cv2.imwrite(str(room / "image_left" / "000000_left.png"), np.zeros((24, 32, 3), np.uint8))
    capture = read_tartanair_v1(room)
    assert (capture.width, capture.height, len(capture)) == (64, 48, 10)
    assert "000000_left.png must be of 64x48 pixels, as the others, got 32x24" in capture.dropped[0]
    assert (
        "000001_left_depth.npy must be of 64x48 pixels, as the others, got 32x24"
        in capture.dropped[1]
    )


def test_v2(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    v2 = tmp_path / "P000"
    (v2 / "image_lcam_front").mkdir(parents=True)
    (v2 / "depth_lcam_front").mkdir()
    (room / "pose_left.txt").rename(v2 / "pose_lcam_front.txt")
    (v2 / "pose_left.txt").write_text((v2 / "pose_lcam_front.txt").read_text())
    for i in range(12):
        image = room / "image_left" / f"{i:06d}_left.png"
        (v2 / "image_lcam_front" / f"{i:06d}_lcam_front.png").write_bytes(image.read_bytes())
        depth = np.load(room / "depth_left" / f"{i:06d}_left_depth.npy")
        packed = depth.astype("<f4")[..., None].view(np.uint8)
        cv2.imwrite(str(v2 / "depth_lcam_front" / f"{i:06d}_lcam_front_depth.png"), packed)
    (v2 / "pose_left.txt").rename(room / "pose_left.txt")
    one, two = read_tartanair_v1(room), read_tartanair_v2(v2)
    assert recognizes_tartanair_v2(v2) and not recognizes_tartanair_v1(v2) and len(two) == 12
    for i in (0, 7):
        np.testing.assert_array_equal(one.frame(i).image, two.frame(i).image)
        np.testing.assert_array_equal(one.frame(i).depth, two.frame(i).depth)
        assert one.X_WCs[i].IsExactlyEqualTo(two.X_WCs[i])
    np.testing.assert_array_equal(one.K, two.K)


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_hospital_reprojects_onto_itself():
    capture = read_tartanair_v1(Path(os.environ["SPLATPILOT_DATA"]) / "tartanair" / "hospital")
    assert len(capture) == 71
    errors = []
    for i in (0, 20, 40, 60):
        a, b = capture.frame(i), capture.frame(i + 1)
        p_W = back_projected(a)[::4, ::4].reshape(-1, 3)
        x, y, z = b.X_WC.inverse().multiply(p_W.T)
        u = np.floor(b.K[0, 0] * x / z + b.K[0, 2]).astype(int)
        v = np.floor(b.K[1, 1] * y / z + b.K[1, 2]).astype(int)
        seen = (z > 0) & (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
        errors.append(np.abs(b.depth[v[seen], u[seen]] / z[seen] - 1))
    assert np.median(np.concatenate(errors)) < 1e-3
