import dataclasses
import subprocess
import sys

import cv2
import numpy as np
import pycolmap
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import CAMERA_POSES, K, assert_shows_room, room_views, trace

from splatpilot.training.captures import photographs
from splatpilot.training.captures.capture import Capture, SfmPoints
from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.colmap import model_folder
from splatpilot.training.captures.up_and_scale import camera_height

SHRINK, VIEWS = 0.25, room_views(K, 64, 48)
# The world of a registration: any rotation, any unit of length.
X_MW = RigidTransform(
    RotationMatrix.MakeXRotation(1.1) @ RotationMatrix.MakeYRotation(0.5), [3, 1, 2]
)


@pytest.fixture
def model(tmp_path):
    """A folder of images with a model, whose points are seen by one image each."""
    path, rng = tmp_path / "castle", np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    (path / "images").mkdir(parents=True)
    for i, view in enumerate(VIEWS):
        cv2.imwrite(str(path / f"images/{i:02d}.png"), view.image[..., ::-1])
        X_MC = X_MW @ view.X_WC
        X_CM = RigidTransform(X_MC.rotation(), SHRINK * X_MC.translation()).inverse()
        columns, rows = rng.integers(0, 64, 60), rng.integers(0, 48, 60)
        pixels = np.stack([columns, rows], axis=1) + 0.5
        points = [pycolmap.Point2D(pixel) for pixel in pixels]
        image = pycolmap.Image(name=f"{i:02d}.png", points2D=points, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(X_CM.GetAsMatrix34()))
        z = view.depth[rows, columns]
        p_CQ = np.column_stack([pixels, np.ones(60)]) @ np.linalg.inv(K).T * z[:, None]
        p_MQ = SHRINK * X_MC.multiply(p_CQ.T).T
        for k, p in enumerate(p_MQ):
            track = pycolmap.Track([pycolmap.TrackElement(i + 1, k)])
            model.add_point3D(p, track, view.image[rows[k], columns[k]])
    (path / "sparse/0").mkdir(parents=True)
    model.write(path / "sparse/0")
    return path


def lengths(X_WCs) -> np.ndarray:
    p = np.array([X_WC.translation() for X_WC in X_WCs])
    return np.linalg.norm(np.diff(p, axis=0), axis=1)


def test_model(model):
    capture = read_capture(model)
    assert not capture.metric and not capture.has_depth and len(capture) == 10
    np.testing.assert_allclose(lengths(capture.X_WCs), SHRINK * lengths(CAMERA_POSES), rtol=1e-9)
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(factor=1 / SHRINK)))
    assert capture.metric
    X_RW = CAMERA_POSES[0] @ capture.X_WCs[0].inverse()
    assert_shows_room(capture, X_RW, color=0.5, depth=None)
    p_RQ = X_RW.multiply(capture.points.p_WQ.T).T
    to_wall = np.minimum(np.abs(p_RQ - [0, -1.5, 0]), np.abs(p_RQ - [6, 1.5, 2.5])).min(axis=1)
    assert to_wall.max() < 1e-9
    assert 0 <= capture.points.colors.min() and capture.points.colors.max() <= 1


@pytest.mark.parametrize(("up", "tilt"), [("cameras", 2.0), ("ground", 0.1)])
def test_up(model, up, tilt):
    capture = read_capture(model, CaptureConfig(up=up))
    R_RW = (CAMERA_POSES[0] @ capture.X_WCs[0].inverse()).rotation().matrix()
    assert np.rad2deg(np.arccos(R_RW[2, 2])) < tilt


@pytest.mark.parametrize("turn", [RotationMatrix.MakeXRotation, RotationMatrix.MakeYRotation])
def test_height_is_above_a_ground_that_agrees_with_the_cameras(model, turn):
    height = float(np.median([X_WC.translation()[2] for X_WC in CAMERA_POSES]))
    scaled = read_capture(model, CaptureConfig(scale=ScaleConfig(camera_height=height)))
    np.testing.assert_allclose(lengths(scaled.X_WCs), lengths(CAMERA_POSES), rtol=1e-3)
    level = read_capture(model)
    center = np.mean([X_WC.translation() for X_WC in level.X_WCs], axis=0)
    p_SQ = np.random.default_rng(0).uniform([-5, -5, 0], [5, 5, 0], (500, 3))

    def over_slope(degrees: float) -> Capture:
        p_WQ = center + turn(np.deg2rad(degrees)).multiply(p_SQ.T).T - [0, 0, 2.0]
        return dataclasses.replace(level, points=SfmPoints(p_WQ, np.zeros((500, 3))))

    assert camera_height(over_slope(5)) == pytest.approx(2.0, rel=0.05)
    with pytest.raises(ValueError, match=r"castle: the most likely ground tilts by (19|20|21) deg"):
        camera_height(over_slope(20))


def test_distance_between_points(model):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    points = [list(reconstruction.images[i].points2D)[7] for i in (1, 4)]
    a, b = (reconstruction.points3D[point.point3D_id].xyz for point in points)
    (u, v), (x, y) = (point.xy for point in points)
    between = [f"00.png@{u + 0.3:.2f},{v:.2f}", f"03.png@{x + 0.3:.2f},{y:.2f}"]
    scale = ScaleConfig(between=between, distance=float(np.linalg.norm(a - b)) / SHRINK)
    capture = read_capture(model, CaptureConfig(scale=scale))
    np.testing.assert_allclose(lengths(capture.X_WCs), lengths(CAMERA_POSES), rtol=1e-9)


def test_depth_of_some_images(model):
    (model / "depth").mkdir()
    for i in (2, 5):
        millimeters = np.round(1000 * VIEWS[i].depth).astype(np.uint16)
        cv2.imwrite(str(model / f"depth/{i:02d}.png"), millimeters)
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(depth_folder="depth")))
    assert capture.metric and capture.has_depth
    np.testing.assert_allclose(lengths(capture.X_WCs), lengths(CAMERA_POSES), rtol=0.02)
    np.testing.assert_allclose(capture.frame(5).depth, VIEWS[5].depth, atol=0.001)
    assert capture.load_depth(0) is None and not capture.frame(0).depth.any()


@pytest.mark.parametrize("name", ["00.png.png", "00.png"])
def test_masks_of_images_are_those_of_their_names(model, name):
    (model / "masks").mkdir()
    mask = np.full((48, 64), 255, np.uint8)
    mask[:24] = 0
    cv2.imwrite(str(model / "masks" / name), mask)
    capture = read_capture(model)
    np.testing.assert_array_equal(capture.frame(0).valid, mask > 0)
    assert capture.frame(1).valid.all()


def test_points_that_only_masked_pixels_show_are_left_out(model):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    for number in range(1, 10):
        seen = [point.point3D_id for point in reconstruction.images[number].points2D][:60]
        image = reconstruction.images[number + 1]
        for each in seen:
            pixel = image.project_point(reconstruction.points3D[each].xyz)
            if pixel is not None and (pixel >= 0).all() and (pixel < [64, 48]).all():
                image.points2D.append(pycolmap.Point2D(pixel))
                element = pycolmap.TrackElement(number + 1, len(image.points2D) - 1)
                reconstruction.add_observation(each, element)
    reconstruction.write(model / "sparse/0")
    before = read_capture(model).points
    (model / "masks").mkdir()
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :32] = 0
    for i in range(10):
        cv2.imwrite(str(model / f"masks/{i:02d}.png.png"), mask)
    capture = read_capture(model)
    assert 50 < len(capture.points.p_WQ) < len(before.p_WQ) / 2
    times = np.zeros(len(capture.points.p_WQ), int)
    for X_WC in capture.X_WCs:
        x, y, z = capture.K @ X_WC.inverse().multiply(capture.points.p_WQ.T)
        times += (z > 0) & (x / z > 31) & (x / z < 64) & (y / z > 0) & (y / z < 48)
    assert (times >= 2).all()


def test_images_in_subfolders_keep_their_paths(model):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    for image in reconstruction.images.values():
        i = image.image_id - 1
        image.name = f"cam{i // 5}/{i % 5:02d}.png"
        (model / "images" / image.name).parent.mkdir(exist_ok=True)
        (model / f"images/{i:02d}.png").rename(model / "images" / image.name)
    reconstruction.write(model / "sparse/0")
    capture = read_capture(model)
    assert list(capture.frame_names) == [f"cam{k}/{i:02d}.png" for k in (0, 1) for i in range(5)]

    def scaled(*between, distance=1.0):
        scale = ScaleConfig(between=list(between), distance=distance)
        return read_capture(model, CaptureConfig(scale=scale))

    baseline = np.linalg.norm(CAMERA_POSES[0].translation() - CAMERA_POSES[5].translation())
    found = scaled("cam0/00.png", "cam1/00.png", distance=float(baseline))
    np.testing.assert_allclose(lengths(found.X_WCs), lengths(CAMERA_POSES), rtol=1e-9)
    u, v = reconstruction.images[6].points2D[7].xy
    assert scaled(f"cam1/00.png@{u},{v}", "cam0/01.png").metric
    with pytest.raises(ValueError, match=r"several .* called '00.png'; choose one of cam0/00.png"):
        scaled("00.png", "cam1/01.png")
    (model / "depth/cam1").mkdir(parents=True)
    np.save(model / "depth/cam1/02.npy", VIEWS[7].depth.astype(np.float32))
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(depth_folder="depth")))
    np.testing.assert_allclose(capture.frame(7).depth, VIEWS[7].depth, rtol=1e-5)
    assert capture.load_depth(2) is None


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ({"between": ["00.png", "xx.png"], "distance": 1}, "no registered image is called 'xx.p"),
        ({"between": ["00.png", "00.png"], "distance": 1}, "are the same point"),
        ({"between": ["00.png@900,1", "00.png"], "distance": 1}, "no registered point within"),
        ({"between": ["00.png@9", "00.png"], "distance": 1}, "does not end in a pixel"),
        ({"between": ["00.png", "01.png"]}, "scale.between and scale.distance must be two"),
        ({"camera_height": 1, "factor": 1}, "given once, got scale.factor and scale.cam"),
        ({"camera_height": -1}, r"camera_height must be in \[0, inf\) m, got -1"),
        ({"depth_folder": "nothing"}, "0 points have a measured depth"),
    ],
)
def test_invalid_scale_is_refused(model, scale, message):
    with pytest.raises(ValueError, match=message):
        read_capture(model, CaptureConfig(scale=ScaleConfig(**scale)))


def test_distorted_model(model):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    camera = reconstruction.cameras[1]
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [50.0, 31.0, 25.0, -0.12]
    reconstruction.write(model / "sparse/0")
    pixels = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1)
    rays = camera.cam_from_img(pixels.reshape(-1, 2)).reshape(48, 64, 2)
    for i, X_WC in enumerate(CAMERA_POSES):
        image = trace(X_WC, rays).image
        cv2.imwrite(str(model / f"images/{i:02d}.png"), image[..., ::-1])
    for focal, given in ((50.0, []), (44.0, [50.0, 50.0, 31.0, 25.0])):
        camera.params = [focal, 31.0, 25.0, -0.12]
        reconstruction.write(model / "sparse/0")
        config = CaptureConfig(scale=ScaleConfig(factor=1 / SHRINK), intrinsics=given)
        capture = read_capture(model, config)
        X_WM = CAMERA_POSES[0] @ capture.X_WCs[0].inverse()
        assert_shows_room(capture, X_WM, color=3.0, depth=None)


def test_missing_and_damaged_parts_are_refused(model):
    points, folder = len(read_capture(model).points.p_WQ), model / "sparse/0"
    reconstruction = pycolmap.Reconstruction(folder)
    next(iter(reconstruction.points3D.values())).xyz = [0, 1e300, 0]
    reconstruction.write(folder)
    assert len(read_capture(model).points.p_WQ) == points - 1
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        file = folder / f"{name}.bin"
        content = file.read_bytes()
        for damaged in (b"\xff" * 8 + content[8:], content[:-1], content + b"\0"):
            file.write_bytes(damaged)
            with pytest.raises(ValueError, match=r"sparse/0: not a readable COLMAP model"):
                read_capture(model)
        file.write_bytes(content)
    (model / "images").rename(model / "elsewhere")
    with pytest.raises(FileNotFoundError, match="none of the model's images"):
        read_capture(model)
    reconstruction.write_text(folder)
    for file in folder.glob("*.bin"):
        file.unlink()
    listed = folder / "images.txt"
    listed.write_bytes(listed.read_bytes().replace(b"03.png", b"\xb5.png"))
    with pytest.raises(ValueError, match=r"sparse/0: not a readable COLMAP model \(.*utf-8"):
        read_capture(model)
    (folder / "cameras.txt").write_text("1 PINHOLE 64")
    with pytest.raises(ValueError, match="not a readable COLMAP model"):
        read_capture(model)


def test_photographs_that_are_left_out_are_named(model, tmp_path, monkeypatch):
    (model / "sparse/0").rename(tmp_path / "model")
    monkeypatch.setattr(photographs, "cached_folder", lambda folder, write: tmp_path / "model")
    cv2.imwrite(str(model / "images/blank.png"), np.zeros((48, 64, 3), np.uint8))
    (model / "images/empty.jpg").write_bytes(b"")
    capture = read_capture(model)
    assert len(capture) == 10 and not capture.metric
    assert "empty.jpg: not a readable image" in capture.dropped[0]
    assert "blank.png: not registered" in capture.dropped[1]


def test_pycolmap_leaves_signal_handlers_and_png_files_alone(tmp_path):
    script = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))\n"
        "from splatpilot.training.captures.colmap import import_pycolmap\n"
        "import_pycolmap()\n"
        "import cv2, numpy as np\n"
        "image = np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)\n"
        "cv2.imwrite(sys.argv[1], image)\n"
        "assert (cv2.imread(sys.argv[1]) == image).all()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "signal.pause()\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "a.png")]
    done = subprocess.run(command, capture_output=True, timeout=60)
    assert (done.returncode, done.stderr) == (7, b"")


def test_largest_of_several_models_is_taken(tmp_path):
    for number, size in ((0, 10), (1, 30), (2, 20)):
        folder = tmp_path / f"sparse/{number}"
        folder.mkdir(parents=True)
        (folder / "cameras.bin").touch()
        (folder / "images.bin").write_bytes(bytes(size))
    assert model_folder(tmp_path) == tmp_path / "sparse/1"
