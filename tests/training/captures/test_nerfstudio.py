import json

import cv2
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from room import CAMERA_POSES, K, assert_shows_room, pinhole_rays, room_views, trace

from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig
from splatpilot.training.captures.capture_registry import read_capture

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def change(path, **keys):
    file = path / "transforms.json"
    content = json.loads(file.read_text())
    for key, value in keys.items():
        if key.startswith("frame_"):
            content["frames"][int(key[6:])] |= value
        else:
            content[key] = value
    file.write_text(json.dumps(content))
    return path


@pytest.fixture
def write(tmp_path):
    def write(rays=None, depth=True, **extra):
        rays = pinhole_rays(K, 64, 48) if rays is None else rays
        frames = []
        for i, X_WC in enumerate(CAMERA_POSES):
            view, matrix = trace(X_WC, rays), (X_WC.GetAsMatrix4() @ OPENGL).tolist()
            cv2.imwrite(str(tmp_path / f"{i:02d}.png"), view.image[..., ::-1])
            frames.append({"file_path": f"./{i:02d}.png", "transform_matrix": matrix})
            if depth:
                np.save(tmp_path / f"{i:02d}.npy", (1000 * view.depth).astype(np.float32))
                frames[i]["depth_file_path"] = f"{i:02d}.npy"
        camera = {"w": 64, "h": 48, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        content = camera | extra | {"frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


def test_room(write):
    capture = read_capture(write())
    assert capture.metric and capture.depth_camera is None
    assert_shows_room(capture, color=0.5)


def test_each_frame_may_have_its_camera(write):
    path = write()
    change(path, frame_3={"cx": K[0, 2] + 4, "cy": K[1, 2] + 4})
    image = cv2.imread(str(path / "03.png"))
    shift = np.float32([[1, 0, 4], [0, 1, 4]])
    cv2.imwrite(str(path / "03.png"), cv2.warpAffine(image, shift, (64, 48)))
    depth = np.load(path / "03.npy")
    np.save(path / "03.npy", cv2.warpAffine(depth, shift, (64, 48)))
    capture = read_capture(path)
    assert not capture.dropped and capture.K[0, 0] > 50
    assert_shows_room(capture, color=4.0, depth=0.02)


def test_depth_may_be_smaller_but_not_of_another_view(write):
    path = write()
    for i, view in enumerate(room_views(np.diag([0.5, 0.5, 1]) @ K, 32, 24)):
        np.save(path / f"{i:02d}.npy", (1000 * view.depth).astype(np.float32))
    capture = read_capture(path)
    assert capture.frame(0).depth.shape == (48, 64)
    assert_shows_room(capture, color=0.5, depth=0.03)
    for i in range(10):
        np.save(path / f"{i:02d}.npy", np.ones((24, 24), np.float32))
    with pytest.raises(ValueError, match="24x24 pixels of depth do not show what 64x48 pixels"):
        read_capture(path)


def test_pixels_are_invalid_where_the_mask_is_black_or_alpha_is_less_than_a_half(write):
    path, mask = write(), np.full((48, 64), 1, np.uint8)
    mask[10:30, 20:50] = 0
    cv2.imwrite(str(path / "mask.png"), mask)
    image = cv2.imread(str(path / "05.png"))
    alpha = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None], 48, axis=0)
    cv2.imwrite(str(path / "05.png"), np.dstack([image, alpha]))
    capture = read_capture(change(path, frame_3={"mask_path": "mask.png"}))
    for i, valid in ((2, mask >= 0), (3, mask > 0), (5, alpha >= 128)):
        frame = capture.frame(i)
        np.testing.assert_array_equal(frame.valid, valid)
        np.testing.assert_array_equal(frame.depth > 0, valid)
    np.testing.assert_array_equal(capture.frame(5).image, image[..., ::-1])
    for kind in ("a mask", "an alpha channel"):
        assert any(f"1 of 10 images have {kind}" in note for note in capture.notes)


def write_images(path, image):
    for i in range(10):
        cv2.imwrite(str(path / f"{i:02d}.png"), image)


def test_pixels_interpolated_from_masked_ones_are_invalid(write):
    path = write(camera_model="OPENCV", k1=-0.2)
    image = np.full((48, 64, 3), 100, np.uint8)
    image[20:28, 24:40] = 255
    write_images(path, image)
    cv2.imwrite(str(path / "mask.png"), np.uint8(image[..., 0] == 100))
    masks = {f"frame_{i}": {"mask_path": "mask.png"} for i in range(10)}
    frame = read_capture(change(path, **masks)).frame(0)
    assert 0.8 < frame.valid.mean() < 1
    assert (frame.image[frame.valid] == 100).all()


@pytest.mark.parametrize(
    ("keys", "held_out", "frames"),
    [
        ({}, None, 10),
        ({"test_filenames": ["./03.png"], "val_filenames": ["04.png"]}, [3, 4], 10),
        ({"train_filenames": ["00.png", "02.png"], "test_filenames": ["08.png"]}, [2], 3),
        ({"test_frames": ["09.png"]}, [9], 10),
        ({"test_frames": slice(6, 10), "frames": slice(6)}, [6, 7, 8, 9], 10),
        ({f"frame_{i}": {"is_bad": True} for i in (1, 2, 5, 6)}, None, 6),
    ],
)
def test_split_and_flags_of_the_files_are_kept(write, keys, held_out, frames):
    path = write()
    every = json.loads((path / "transforms.json").read_text())["frames"]
    keys = {name: every[key] if isinstance(key, slice) else key for name, key in keys.items()}
    capture = read_capture(change(path, **keys))
    assert capture.held_out == held_out and len(capture) == frames
    assert len(capture.dropped) == 10 - frames


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_RADIAL"])
@pytest.mark.parametrize("k", [(0.02, -0.01, 0.005, 0.4, 0, 0), (-0.15, 0.03, 0, 0, 0.002, -0.001)])
def test_distortion_is_taken_out(write, model, k):
    bent = rays = pinhole_rays(K, 64, 48)
    for _ in range(50):
        x, y = rays[..., :1], rays[..., 1:]
        r2 = x**2 + y**2
        radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3 + k[3] * r2**4
        aside = 2 * k[4] * x * y + k[5] * (r2 + 2 * x**2), k[4] * (r2 + 2 * y**2) + 2 * k[5] * x * y
        rays = (bent - np.concatenate(aside, axis=-1)) / radial
    names = "k1", "k2", "k3", "k4", "p1", "p2"
    path = write(rays, camera_model=model, **dict(zip(names, k, strict=True)))
    named = read_capture(path)
    listed = change(path, **dict.fromkeys(names, 0), distortion_params=k)
    for capture in (named, read_capture(listed)):
        assert_shows_room(capture, color=3.0, depth=0.02)
        frame = capture.frame(0)
        seen = trace(frame.X_WC, pinhole_rays(capture.K, 64, 48)[:6, :6])
        np.testing.assert_allclose(frame.depth[:6, :6], seen.depth, rtol=0.03)


def test_fisheye_is_taken_out_and_cropped_to_its_radius(write):
    bent = pinhole_rays(K, 64, 48)
    theta = np.linalg.norm(bent, axis=-1, keepdims=True)
    path = write(bent * np.tan(theta) / theta, camera_model="OPENCV_FISHEYE")
    assert_shows_room(read_capture(path), color=3.0, depth=0.02)
    image = np.zeros((48, 64, 3), np.uint8)
    v, u = np.mgrid[0:48, 0:64] + 0.5
    image[np.hypot(u - 32, v - 24) < 21] = 90
    write_images(change(path, fisheye_crop_radius=20.0), image)
    assert (read_capture(path).frame(0).image == 90).all()


def test_intrinsics_their_source_and_unused_keys_are_noted(write):
    path = change(write(cx=10), aabb_scale=16, applied_scale=1.0, frame_2={"sharpness": 30.0})
    notes = read_capture(path).notes
    size = "fx 50.0, fy 52.0, cx 10.0, cy 25.0 px for 64x48 px"
    assert any(note.endswith(f"{size}, from transforms.json") for note in notes)
    assert any("(10.0, 25.0) px is far from the center" in note for note in notes)
    assert "transforms.json: aabb_scale, sharpness is not used" in notes
    _, note = read_capture(path, CaptureConfig(intrinsics=[40, 41, 32, 24])).notes
    assert "fx 40.0, fy 41.0, cx 32.0, cy 24.0 px for 64x48 px, from capture.intrinsics" in note


def test_points_and_scale_of_a_capture_without_depth(write):
    path = write(depth=False, ply_file_path="points.ply")
    rows = [(1.0, 2.0, 3.0, 255, 0, 51)]
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = PlyElement.describe(np.array(rows, dtype=kinds), "vertex")
    PlyData([vertices]).write(str(path / "points.ply"))
    capture = read_capture(path)
    assert not capture.metric and not capture.has_depth
    np.testing.assert_allclose(capture.points.p_WQ, [[1, 2, 3]])
    np.testing.assert_allclose(capture.points.colors, [[1, 0, 0.2]])
    scale = ScaleConfig(between=["00.png", "09.png"], distance=10.0)
    scaled = read_capture(path, CaptureConfig(scale=scale))
    p = [X_WC.translation() for X_WC in scaled.X_WCs]
    assert scaled.metric and np.linalg.norm(p[9] - p[0]) == pytest.approx(10)


_CAMERA = "invalid camera of 00.png .*"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be .*, got EQUIRECTANGULAR"),
        ({"frames": 3}, "not a readable file of nerfstudio's format"),
        ({"frames": [{"file_path": "00.png"}]}, "transform_matrix"),
        ({"depth_unit_scale_factor": 0}, "depth_unit_scale_factor must be .* got 0"),
        ({"fl_x": "wide"}, _CAMERA),
        ({"w": np.inf}, f"{_CAMERA}infinity"),
        ({"w": 10**9}, f"{_CAMERA}image size must be .* got 1000000000x48"),
        ({"fl_x": -40}, rf"{_CAMERA}focal lengths must be .* got \[-40"),
        ({"fl_x": np.nan}, rf"{_CAMERA}focal lengths must be .* got \[nan"),
        ({"cx": 64.5}, rf"{_CAMERA}principal point must be in the image of 64x48 px, got \[64\.5"),
        ({"k1": np.nan}, f"{_CAMERA}distortion"),
        ({"test_filenames": ["99.png"]}, r"its split names 99\.png"),
        ({"train_filenames": []}, "its split leaves no frame"),
    ],
)
def test_invalid_transforms_are_refused(write, keys, message):
    with pytest.raises(ValueError, match=rf"transforms\.json: .*{message}"):
        read_capture(change(write(), **keys))


@pytest.mark.parametrize(
    ("frame", "depth", "message"),
    [
        ({}, np.full((48, 64), 1 + 1j), "02.npy"),
        ({}, np.full((48, 64), np.datetime64("2026-01-01")), "02.npy"),
        ({}, np.ones((48, 64), bool), "02.npy"),
        ({}, b"\x93NUMPY\x01\x00G\x00{'descr': '<f4', 'fortran_order': False, 'shape': (99999,"
             b" 99999)}", "02.npy"),
        ({}, b"\x93NUMPY\x01\x00\xff\xff nonsense", "02.npy"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, None, "frame 2 (./02.png): transform_matrix"),
        ({"mask_path": "small.png"}, None, "small.png must be of 64x48 pixels"),
    ],
)  # fmt: skip
def test_invalid_frame_is_left_out(write, frame, depth, message):
    path = change(write(), frame_2=frame)
    cv2.imwrite(str(path / "small.png"), np.ones((24, 32), np.uint8))
    if isinstance(depth, bytes):
        (path / "02.npy").write_bytes(depth)
    elif depth is not None:
        np.save(path / "02.npy", depth)
    capture = read_capture(path)
    assert len(capture) == 9 and message in capture.dropped[0]
