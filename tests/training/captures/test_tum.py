import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform
from room import CAMERA_POSES, assert_shows_room, room_views

from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig
from splatpilot.training.captures.capture_registry import read_capture

FX, CX = 525.0, 320.0


@pytest.fixture
def sequence(tmp_path):
    K = np.array([[FX, 0, CX], [0, FX, 240.0], [0, 0, 1]]) * [[1 / 8], [1 / 8], [1]]
    (tmp_path / "rgb").mkdir()
    (tmp_path / "depth").mkdir()
    lists = {"rgb": ["# color images"], "depth": ["# depth maps"], "groundtruth": ["# t pose"]}
    for i, view in enumerate(room_views(K, 80, 60)):
        time = 100.0 + i / 30
        cv2.imwrite(str(tmp_path / f"rgb/{time:.6f}.png"), view.image[..., ::-1])
        depth = np.round(5000 * view.depth).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"depth/{time:.6f}.png"), depth)
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{time + 0.01:.6f} depth/{time:.6f}.png")
        w, x, y, z = view.X_WC.rotation().ToQuaternion().wxyz()
        p = view.X_WC.translation()
        for offset in (-0.005, 0.005):
            # The camera passes the position of the frame half-way between the two stamps.
            row = (time + offset, *(p + np.array([100 * offset, 0, 0])), x, y, z, w)
            lists["groundtruth"].append(" ".join(f"{value:.6f}" for value in row))
    for name, lines in lists.items():
        (tmp_path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_room(sequence):
    capture = read_capture(sequence)
    assert len(capture) == 10 and not capture.dropped
    assert_shows_room(capture, color=0.5, depth=0.001)


def test_spaces_around_names_are_ignored(sequence):
    for name in ("rgb", "depth"):
        file = sequence / f"{name}.txt"
        file.write_text(file.read_text().replace(".png\n", ".png \n"))
    assert len(read_capture(sequence)) == 10


def test_depth_of_a_separate_camera_is_registered(sequence):
    K_D, X_DC = np.array([[55.0, 0, 32], [0, 55, 24], [0, 0, 1]]), RigidTransform([0.2, -0.1, 0])
    poses = [X_WC @ X_DC.inverse() for X_WC in CAMERA_POSES]
    files = sorted((sequence / "depth").iterdir())
    for file, view in zip(files, room_views(K_D, 64, 48, poses), strict=True):
        cv2.imwrite(str(file), np.round(5000 * view.depth).astype(np.uint16))
    config = CaptureConfig(depth_intrinsics=[55, 55, 32, 24], p_DC=[0.2, -0.1, 0])
    assert_shows_room(read_capture(sequence, config), color=0.5, depth=0.01)


def test_positions_in_other_units_are_scaled(sequence):
    file = sequence / "groundtruth.txt"
    rows = np.loadtxt(file)
    rows[:, 1:4] *= 100
    np.savetxt(file, rows, fmt="%.6f")
    config = CaptureConfig(scale=ScaleConfig(factor=0.01))
    assert_shows_room(read_capture(sequence, config), color=0.5, depth=0.001)


@pytest.mark.parametrize(
    ("name", "center"),
    [
        ("rgbd_dataset_freiburg1_room", (319.1, 255.8)),
        ("rgbd_dataset_freiburg2_xyz", (325.6, 250.2)),
        ("fr3_office", (320.6, 248.1)),
        ("rgbd_bonn_balloon", (316.09352, 238.256098)),
        ("afr1_desk", (320.0, 240.0)),
    ],
)
def test_name_of_the_folder_or_the_listed_bag_tells_the_camera(sequence, tmp_path, name, center):
    capture = read_capture(sequence.rename(tmp_path.with_name(name)))
    np.testing.assert_allclose(capture.K[:2, 2], np.array(center) / 8)
    assert capture.K[0, 0] >= 517.3 / 8
    assert ("set capture.intrinsics" in capture.notes[0]) == (name == "afr1_desk")
    path = tmp_path.with_name(name)
    text = (path / "rgb.txt").read_text()
    (path / "rgb.txt").write_text(f"# file: 'rgbd_dataset_freiburg1_desk.bag'\n{text}")
    capture = read_capture(path.rename(tmp_path.with_name(f"desk_{center[0]}")))
    np.testing.assert_allclose(capture.K[:2, 2], np.array([319.1, 255.8]) / 8)
    assert capture.notes[0].endswith("from the name freiburg1")


def test_calibration_next_to_the_images_is_read(sequence):
    (sequence / "calibration.txt").write_text("62.8742 63.5 38.3309 29.5\n")
    capture = read_capture(sequence)
    expected = [[62.8742, 0, 38.8309], [0, 63.5, 30], [0, 0, 1]]
    np.testing.assert_allclose(capture.K, expected)
    assert capture.notes[0].endswith("from calibration.txt")
    (sequence / "calibration.txt").write_text("fx: 62.8742\n")
    with pytest.raises(ValueError, match=r"calibration\.txt must be fx fy cx cy"):
        read_capture(sequence)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("depth.txt", "# nothing\n", "lists no file"),
        ("rgb.txt", "100.0\n", "line 1 must be a time and a file name, got '100.0'"),
        ("groundtruth.txt", "1 2 3\n", "line 1 must be a pose .* got '1 2 3'"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 1\n", "finite poses must be at least 2, got 1"),
        (
            "groundtruth.txt",
            "1e6 0 0 0 0 0 0 1\n1000001 0 0 0 0 0 0 1\n",
            r"runs from 1000000\.000 to .*rgb\.txt from 100\.000",
        ),
    ],
)
def test_bad_lists(sequence, name, text, message):
    (sequence / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{name}.*{message}"):
        read_capture(sequence)


def test_images_without_depth_or_pose_are_left_out(sequence):
    lines = (sequence / "depth.txt").read_text().splitlines()
    (sequence / "depth.txt").write_text("\n".join(lines[:-1]))
    rows = np.loadtxt(sequence / "groundtruth.txt").reshape(10, 2, 8).mean(axis=1)
    np.savetxt(sequence / "groundtruth.txt", rows[::4], fmt="%.6f")
    capture = read_capture(sequence)
    assert len(capture) == 3
    assert "7 of 10 color images have no depth within 0.02 s" in capture.dropped[0]
    assert list(capture.frame_names) == [f"{100 + i / 30:.6f}.png" for i in (0, 4, 8)]
    assert_shows_room(capture, color=0.5, depth=0.001)


def test_times_in_nanoseconds_with_a_byte_order_mark(sequence):
    for name in ("rgb", "depth", "groundtruth"):
        file, rows = sequence / f"{name}.txt", []
        for line in file.read_text().splitlines()[1:]:
            time, rest = line.split(" ", 1)
            rows.append(f"{int((1_700_000_000 + float(time)) * 1e9)} {rest}")
        file.write_text("\n".join(rows), encoding="utf-8-sig")
    capture = read_capture(sequence)
    assert len(capture) == 10 and not capture.dropped
