import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from flysplat.training.captures.tartanair import is_tartanair_v1, read_tartanair_v1


def back_projected(frame) -> np.ndarray:
    """World points (H, W, 3) of all pixels."""
    height, width = frame.depth.shape
    rows, columns = np.mgrid[0:height, 0:width]
    p_CQ = frame.back_project(columns + 0.5, rows + 0.5, frame.depth.astype(float))
    return frame.X_WC.multiply(p_CQ.reshape(-1, 3).T).T.reshape(height, width, 3)


def test_world_is_north_west_up(tmp_path, write_room, room_in_W):
    """Depth back-projects onto the walls of the room, mirrored from north-east-down to z up."""
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    assert (len(capture), capture.width, capture.height, capture.name) == (12, 64, 48, "room")
    lower, upper = room_in_W
    for frame in capture.frames():
        p_W = back_projected(frame)
        to_wall = np.minimum(np.abs(p_W - lower), np.abs(p_W - upper)).min(axis=-1)
        assert to_wall.max() < 1e-5
        assert (p_W > lower - 1e-5).all() and (p_W < upper + 1e-5).all()


def test_first_pose_by_hand(tmp_path, write_room):
    """A level camera that looks north looks along x, with the image's right along -y."""
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    X_WC = capture.frame(0).X_WC
    np.testing.assert_allclose(X_WC.translation(), [0.8, 0, 1.1], atol=1e-9)
    np.testing.assert_allclose(
        X_WC.rotation().matrix(), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-8
    )


def test_colors_belong_to_the_points(tmp_path, write_room, color_of_room):
    """The RGB of each pixel is that of the point its depth leads to."""
    capture = read_tartanair_v1(write_room(tmp_path / "room"))
    frame = capture.frame(5)
    p_N = back_projected(frame) * [1, -1, -1]
    assert frame.image.dtype == np.uint8
    np.testing.assert_allclose(frame.image / 255, color_of_room(p_N), atol=0.5 / 255 + 1e-4)


def test_intrinsics_scale_with_the_image(tmp_path, write_room):
    """The field of view is 90 degrees at every size."""
    capture = read_tartanair_v1(write_room(tmp_path / "room", width=80, height=60))
    np.testing.assert_array_equal(capture.K, [[40, 0, 40], [0, 40, 30], [0, 0, 1]])


def test_frames_are_loaded_when_asked_for(tmp_path, write_room):
    """Opening a capture reads no depth; an unreadable one fails when its frame is loaded."""
    room = write_room(tmp_path / "room")
    bad = room / "depth_left" / "000007_left_depth.npy"
    bad.write_bytes(b"not an array")
    capture = read_tartanair_v1(room)
    capture.frame(6)
    with pytest.raises(ValueError, match=r"000007_left_depth\.npy: not a readable array"):
        capture.frame(7)
    with pytest.raises(IndexError, match=r"frame 12 of room: .* 0 to 11"):
        capture.frame(12)


def test_invalid_depth_is_unknown(tmp_path, write_room):
    """NaN and negative depths become 0, unknown; infinite ones stay."""
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
    """A missing folder or pose file is named, with the layout that is needed."""
    room = write_room(tmp_path / "room")
    (room / part).rename(room / "elsewhere")
    with pytest.raises(FileNotFoundError, match=rf"{part}: does not exist; a TartanAir V1"):
        read_tartanair_v1(room)


def test_missing_folder(tmp_path):
    """A folder that is not there is named."""
    with pytest.raises(FileNotFoundError, match="nowhere: does not exist"):
        read_tartanair_v1(tmp_path / "nowhere")
    assert not is_tartanair_v1(tmp_path / "nowhere")


def test_empty_image_folder(tmp_path, write_room):
    """A folder without images is an error."""
    room = write_room(tmp_path / "room")
    for file in (room / "image_left").iterdir():
        file.unlink()
    with pytest.raises(FileNotFoundError, match="image_left: holds no file named like"):
        read_tartanair_v1(room)


def test_missing_frame(tmp_path, write_room):
    """A depth without image, or an image without depth, is named with the numbers of both."""
    room = write_room(tmp_path / "room")
    (room / "image_left" / "000003_left.png").unlink()
    with pytest.raises(ValueError, match=r"image_left: no file for frame 000003.*11 images, 12"):
        read_tartanair_v1(room)
    (room / "depth_left" / "000003_left_depth.npy").unlink()
    with pytest.raises(ValueError, match=r"pose_left\.txt: 12 poses for 11 images"):
        read_tartanair_v1(room)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 0 0 0 0 0", "is no pose; seven finite numbers"),
        ("0 0 nan 0 0 0 1", "is no pose; seven finite numbers"),
        ("a b c d e f g", "is no pose; seven finite numbers"),
        ("0 0 0 0 0 0 1.1", r"length 1\.1, 1 within 0\.001"),
        ("0 0 0 0 0 0 0", r"length 0, 1 within 0\.001"),
    ],
)
def test_bad_pose(tmp_path, write_room, line, message):
    """A line that is no pose is named by file and number."""
    room = write_room(tmp_path / "room")
    lines = (room / "pose_left.txt").read_text().splitlines()
    lines[4] = line
    (room / "pose_left.txt").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=rf"pose_left\.txt, line 5: .*{message}"):
        read_tartanair_v1(room)


@pytest.mark.parametrize("file", ["image_left/000002_left.png", "depth_left/000002_left_depth.npy"])
def test_empty_file(tmp_path, write_room, file):
    """A zero-byte file is found on opening."""
    room = write_room(tmp_path / "room")
    (room / file).write_bytes(b"")
    with pytest.raises(ValueError, match=rf"{Path(file).name}: the file is empty"):
        read_tartanair_v1(room)


def test_unreadable_image(tmp_path, write_room):
    """A file that is no image is named."""
    room = write_room(tmp_path / "room")
    file = room / "image_left" / "000002_left.png"
    file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(ValueError, match=r"000002_left\.png: not a readable image"):
        read_tartanair_v1(room).frame(2)


def test_other_size(tmp_path, write_room):
    """An image or a depth of another size than the first image is named with both sizes."""
    room = write_room(tmp_path / "room")
    np.save(room / "depth_left" / "000001_left_depth.npy", np.ones((24, 32), np.float32))
    cv2.imwrite(str(room / "image_left" / "000002_left.png"), np.zeros((24, 32, 3), np.uint8))
    capture = read_tartanair_v1(room)
    with pytest.raises(ValueError, match=r"000001_left_depth\.npy: .*\(24, 32\).*\(48, 64\)"):
        capture.frame(1)
    with pytest.raises(ValueError, match=r"000002_left\.png: .*\(24, 32, 3\).*\(48, 64, 3\)"):
        capture.frame(2)


@pytest.mark.skipif("FLYSPLAT_DATA" not in os.environ, reason="FLYSPLAT_DATA is not set")
def test_hospital_reprojects_onto_itself():
    """In the real sequence, depth carried from frame to frame agrees to a tenth of a percent."""
    capture = read_tartanair_v1(Path(os.environ["FLYSPLAT_DATA"]) / "tartanair" / "hospital")
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
