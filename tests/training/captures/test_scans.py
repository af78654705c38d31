import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform
from room import CAMERA_POSES, K, assert_shows_room, room_views

from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture

P_DC = [0.2, -0.1, 0.0]
K_D = np.array([[55.0, 0, 32], [0, 55.0, 24], [0, 0, 1]])


@pytest.fixture
def path(tmp_path) -> Path:
    X_DC = RigidTransform(np.array(P_DC))
    colors = room_views(K, 64, 48)
    depths = room_views(K_D, 64, 48, [X_WC @ X_DC.inverse() for X_WC in CAMERA_POSES])
    for i in range(10):
        stem = str(tmp_path / f"frame-{10 * i:06d}")
        cv2.imwrite(f"{stem}.color.png", colors[i].image[..., ::-1])
        millimeters = np.round(1000 * depths[i].depth).astype(np.uint16)
        millimeters[0, 0], millimeters[0, 1] = 0, 65535
        cv2.imwrite(f"{stem}.depth.png", millimeters)
        np.savetxt(f"{stem}.pose.txt", depths[i].X_WC.GetAsMatrix4())
    return tmp_path


@pytest.fixture
def config():
    intrinsics = [50.0, 52.0, 31.0, 25.0]
    fields = {"intrinsics": intrinsics, "depth_intrinsics": [55.0, 55.0, 32.0, 24.0]}
    return lambda **changes: CaptureConfig(**{"p_DC": P_DC, "up": "z"} | fields | changes)


def test_frames_of_two_cameras(path, config):
    capture = read_capture(path, config())
    assert capture.depth_camera is not None and len(capture) == 10 and not capture.dropped
    assert_shows_room(capture, color=0.5, depth=0.01)
    depth = capture.load_depth(0)
    assert not depth[0, :2].any() and (depth[1:] > 0).all() and depth.max() < 10
    twice = read_capture(path, config(depth_unit=500)).load_depth(0)
    np.testing.assert_allclose(twice, 2 * depth)


def test_config_file_in_the_folder(path, config):
    (path / "capture.yaml").write_text("intrinsics: [40, 41, 30, 20]\nup: z\n")
    np.testing.assert_array_equal(read_capture(path).K, [[40, 0, 30], [0, 41, 20], [0, 0, 1]])
    np.testing.assert_array_equal(read_capture(path, config()).K[0], [50, 0, 31])
    for text, message in (
        ("intrinsic: [1]\n", "there is no field intrinsic"),
        ("intrinsics: [0, 1, 2, 3]\n", r".*intrinsics must be of focal lengths > 0, got \[0.0"),
    ):
        (path / "capture.yaml").write_text(text)
        with pytest.raises(ValueError, match=rf"capture\.yaml: {message}"):
            read_capture(path)


@pytest.mark.parametrize(
    ("part", "content", "message"),
    [
        ("pose.txt", 4 * "nan 0 0 1\n", "the pose is not finite"),
        ("pose.txt", None, "No such file"),
        ("pose.txt", "1 0 0\n", "line 1 must be a row of a 4x4 matrix, got '1 0 0'"),
        ("pose.txt", np.diag([2, 1, 1, 1]), "the rotation must be"),
        ("pose.txt", np.diag([1, 1, -1, 1]), "the rotation must be .*determinant -1"),
        ("pose.txt", np.eye(4) + 900 * np.eye(4, k=3), "position .* is far from all others"),
        ("depth.png", b"", "not a readable image"),
        ("depth.png", None, "No such file"),
        ("depth.png", np.zeros((24, 32), np.uint16), "must be of 64x48 pixels, .* got 32x24"),
        ("depth.png", np.zeros((48, 64), np.uint8), "depth must be one number per pixel"),
        ("depth.png", np.zeros((48, 64, 3), np.uint8), "depth must be one number per pixel"),
        ("color.png", b"no image", "not a readable image"),
        ("color.png", cv2.imencode(".png", np.zeros((48, 64, 3)))[1].tobytes()[:-9], "its end"),
        ("color.png", np.zeros((24, 32, 3), np.uint8), "must be of 64x48 pixels, .* got 32x24"),
    ],
)
def test_one_bad_frame_is_left_out(path, config, part, content, message):
    whole, file = read_capture(path, config()), path / f"frame-000040.{part}"
    if content is None:
        file.unlink()
    elif isinstance(content, str | bytes):
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    elif part == "pose.txt":
        np.savetxt(file, content)
    else:
        cv2.imwrite(str(file), content)
    capture = read_capture(path, config())
    assert len(capture.dropped) == 1 and len(capture) == 9
    assert "frame-000040" in capture.dropped[0] and re.search(message, capture.dropped[0])
    assert "frame-000040.color.png" not in capture.frame_names
    np.testing.assert_array_equal(capture.frame(4).image, whole.frame(5).image)
    assert capture.X_WCs[4].IsNearlyEqualTo(whole.X_WCs[5], 0)
    for i in (0, 3):
        (path / f"frame-{10 * i:06d}.depth.png").unlink()
    dropped = rf"7 of 10 frames .* 80%.*{message}|7 of 10 frames .* 80%.*000000\.depth\.png"
    with pytest.raises(ValueError, match=dropped):
        read_capture(path, config())


K_D_SCANNET = np.array([[24.0, 0, 16], [0, 24.0, 12], [0, 0, 1]])


@pytest.fixture
def scannet(tmp_path):
    for name in ("color", "depth", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    colors, depths = room_views(K, 64, 48), room_views(K_D_SCANNET, 32, 24)
    for i, (color, depth) in enumerate(zip(colors, depths, strict=True)):
        cv2.imwrite(str(tmp_path / f"color/{i}.png"), color.image[..., ::-1])
        millimeters = np.round(1000 * depth.depth).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"depth/{i}.png"), millimeters)
        np.savetxt(tmp_path / f"pose/{i}.txt", color.X_WC.GetAsMatrix4())
    for name, intrinsics in (("color", K), ("depth", K_D_SCANNET)):
        matrix = np.eye(4)
        matrix[:3, :3] = intrinsics
        matrix[:2, 2] -= 0.5  # counted from the first pixel's center
        np.savetxt(tmp_path / f"intrinsic/intrinsic_{name}.txt", matrix)
    return tmp_path


def test_room(scannet):
    capture = read_capture(scannet)
    assert capture.source.startswith("ScanNet") and not capture.dropped
    assert_shows_room(capture, color=0.5, depth=0.03)


def test_intrinsics_of_larger_images_are_refused(scannet):
    matrix = np.eye(4)
    matrix[:2, :3] = [[117.019, 0, 64.275], [0, 117.019, 47.875]]
    np.savetxt(scannet / "intrinsic/intrinsic_color.txt", matrix)
    with pytest.raises(ValueError, match=r"principal point must be in the image of 64x48 px, got"):
        read_capture(scannet)
    given = CaptureConfig(intrinsics=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    np.testing.assert_allclose(read_capture(scannet, given).K, K)


def test_frames_of_lost_tracking_do_not_count(scannet):
    for i in (1, 4, 5):
        np.savetxt(scannet / f"pose/{i}.txt", np.full((4, 4), -np.inf))
    capture = read_capture(scannet)
    assert len(capture) == 7 and "tracking was lost in 3 frames" in capture.dropped[0]
    for i in (2, 3):
        (scannet / f"pose/{i}.txt").write_text("1 2\n")
    with pytest.raises(ValueError, match=r"5 of 7 frames can be used.*tracking was lost"):
        read_capture(scannet)
