import dataclasses
import subprocess
import sys

import cv2
import numpy as np
import pycolmap
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import Capture, SfmPoints
from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.colmap import model_folder
from splatpilot.training.captures.up_and_scale import camera_height

SHRINK = 0.25
# The world of a registration: any rotation, any unit of length.
X_MW = RigidTransform(
    RotationMatrix.MakeXRotation(1.1) @ RotationMatrix.MakeYRotation(0.5), [3, 1, 2]
)


def write_model(path, K, views) -> pycolmap.Reconstruction:
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    (path / "images").mkdir(parents=True)
    for i, view in enumerate(views):
        cv2.imwrite(str(path / f"images/{i:02d}.png"), view.image[..., ::-1])
        X_MC = X_MW @ view.X_WC
        X_CM = RigidTransform(X_MC.rotation(), SHRINK * X_MC.translation()).inverse()
        columns, rows = rng.integers(0, 64, 60), rng.integers(0, 48, 60)
        points = [pycolmap.Point2D([u + 0.5, v + 0.5]) for u, v in zip(columns, rows, strict=True)]
        image = pycolmap.Image(name=f"{i:02d}.png", points2D=points, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(X_CM.GetAsMatrix34()))
        for k, (u, v) in enumerate(zip(columns, rows, strict=True)):
            z = view.depth[v, u]
            q = [(u + 0.5 - K[0, 2]) / K[0, 0] * z, (v + 0.5 - K[1, 2]) / K[1, 1] * z, z]
            p = SHRINK * X_MW.multiply(view.X_WC.multiply(np.array(q)))
            track = pycolmap.Track([pycolmap.TrackElement(i + 1, k)])
            model.add_point3D(p, track, view.image[v, u])
    return model


@pytest.fixture
def model(tmp_path, K, room_views):
    path = tmp_path / "castle"
    (path / "sparse/0").mkdir(parents=True)
    write_model(path, K, room_views(K, 64, 48)).write(path / "sparse/0")
    return path


def lengths(X_WCs) -> np.ndarray:
    p = np.array([X_WC.translation() for X_WC in X_WCs])
    return np.linalg.norm(np.diff(p, axis=0), axis=1)


def test_model(model, room_poses, shows_room):
    capture = read_capture(model)
    assert not capture.metric and not capture.has_depth and len(capture) == 10
    np.testing.assert_allclose(lengths(capture.X_WCs), SHRINK * lengths(room_poses), rtol=1e-9)
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(factor=1 / SHRINK)))
    assert capture.metric
    X_RW = room_poses[0] @ capture.X_WCs[0].inverse()
    shows_room(capture, X_RW, color=0.5, depth=None)
    assert capture.points is not None
    p_RQ = X_RW.multiply(capture.points.p_WQ.T).T
    to_wall = np.minimum(np.abs(p_RQ - [0, -1.5, 0]), np.abs(p_RQ - [6, 1.5, 2.5])).min(axis=1)
    assert to_wall.max() < 1e-9
    assert 0 <= capture.points.colors.min() and capture.points.colors.max() <= 1


@pytest.mark.parametrize("up", ["cameras", "ground"])
def test_up(model, room_poses, up):
    capture = read_capture(model, CaptureConfig(up=up))
    X_RW = room_poses[0] @ capture.X_WCs[0].inverse()
    tilt = np.rad2deg(np.arccos(X_RW.rotation().matrix()[2, 2]))
    assert tilt < (0.1 if up == "ground" else 2)


def test_camera_height(model, room_poses):
    height = np.median([X_WC.translation()[2] for X_WC in room_poses])
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(camera_height=float(height))))
    np.testing.assert_allclose(lengths(capture.X_WCs), lengths(room_poses), rtol=1e-3)


@pytest.mark.parametrize("turn", [RotationMatrix.MakeXRotation, RotationMatrix.MakeYRotation])
def test_ground_that_cameras_contradict(model, turn):
    level = read_capture(model)
    center = np.mean([X_WC.translation() for X_WC in level.X_WCs], axis=0)

    def over_slope(degrees: float, depth: float) -> Capture:
        p_SQ = np.random.default_rng(0).uniform([-5, -5, 0], [5, 5, 0], (500, 3))
        p_WQ = center + turn(np.deg2rad(degrees)).multiply(p_SQ.T).T - [0, 0, depth]
        return dataclasses.replace(level, points=SfmPoints(p_WQ, np.zeros((500, 3))))

    assert camera_height(over_slope(5, 2.0)) == pytest.approx(2.0, rel=0.05)
    with pytest.raises(
        ValueError, match=r"castle: the most likely ground tilts by (19|20|21) degrees"
    ):
        camera_height(over_slope(20, 2.0))


def test_distance_between_points(model, K, room_views, room_poses):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    points = [list(reconstruction.images[i].points2D)[7] for i in (1, 4)]
    a, b = (reconstruction.points3D[point.point3D_id].xyz for point in points)
    between = [
        f"{name}@{point.xy[0] + 0.3:.2f},{point.xy[1]:.2f}"
        for name, point in zip(("00.png", "03.png"), points, strict=True)
    ]
    distance = float(np.linalg.norm(a - b)) / SHRINK
    scale = ScaleConfig(between=between, distance=distance)
    capture = read_capture(model, CaptureConfig(scale=scale))
    np.testing.assert_allclose(lengths(capture.X_WCs), lengths(room_poses), rtol=1e-9)


def test_depth_of_some_images(model, K, room_views, room_poses):
    (model / "depth").mkdir()
    views = room_views(K, 64, 48)
    for i in (2, 5):
        millimeters = np.round(1000 * views[i].depth).astype(np.uint16)
        cv2.imwrite(str(model / f"depth/{i:02d}.png"), millimeters)
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(depth_folder="depth")))
    assert capture.metric and capture.has_depth
    np.testing.assert_allclose(lengths(capture.X_WCs), lengths(room_poses), rtol=0.02)
    np.testing.assert_allclose(capture.frame(5).depth, views[5].depth, atol=0.001)
    assert capture.load_depth(0) is None and not capture.frame(0).depth.any()


@pytest.fixture
def tracked(model):
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
    return model


@pytest.mark.parametrize("name", ["00.png.png", "00.png"])
def test_masks_of_images_are_those_of_their_names(model, name):
    (model / "masks").mkdir()
    mask = np.full((48, 64), 255, np.uint8)
    mask[:24] = 0
    cv2.imwrite(str(model / "masks" / name), mask)
    capture = read_capture(model)
    np.testing.assert_array_equal(capture.frame(0).valid, mask > 0)
    assert capture.frame(1).valid.all()


def test_points_that_only_masked_pixels_show_are_left_out(tracked):
    before = read_capture(tracked).points
    (tracked / "masks").mkdir()
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :32] = 0
    for i in range(10):
        cv2.imwrite(str(tracked / f"masks/{i:02d}.png.png"), mask)
    capture = read_capture(tracked)
    assert before is not None and capture.points is not None
    assert 50 < len(capture.points.p_WQ) < len(before.p_WQ) / 2
    times = np.zeros(len(capture.points.p_WQ), int)
    for X_WC in capture.X_WCs:
        x, y, z = capture.K @ X_WC.inverse().multiply(capture.points.p_WQ.T)
        times += (z > 0) & (x / z > 31) & (x / z < 64) & (y / z > 0) & (y / z < 48)
    assert (times >= 2).all()


@pytest.fixture
def rig(model):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    for image in reconstruction.images.values():
        i = image.image_id - 1
        image.name = f"cam{i // 5}/{i % 5:02d}.png"
        file = model / "images" / image.name
        file.parent.mkdir(exist_ok=True)
        (model / f"images/{i:02d}.png").rename(file)
    reconstruction.write(model / "sparse/0")
    return model


def test_images_in_subfolders_keep_their_paths(rig, room_poses):
    capture = read_capture(rig)
    assert list(capture.frame_names) == [f"cam{k}/{i:02d}.png" for k in (0, 1) for i in range(5)]
    baseline = room_poses[0].translation() - room_poses[5].translation()
    between, distance = ["cam0/00.png", "cam1/00.png"], float(np.linalg.norm(baseline))
    scaled = read_capture(rig, CaptureConfig(scale=ScaleConfig(between=between, distance=distance)))
    np.testing.assert_allclose(lengths(scaled.X_WCs), lengths(room_poses), rtol=1e-9)
    scale = ScaleConfig(between=["00.png", "cam1/01.png"], distance=1)
    with pytest.raises(ValueError, match=r"several .* called '00.png'; choose one of cam0/00.png"):
        read_capture(rig, CaptureConfig(scale=scale))


def test_pixels_and_depth_of_images_in_subfolders(rig, K, room_views):
    point = pycolmap.Reconstruction(rig / "sparse/0").images[6].points2D[7].xy
    between = [f"cam1/00.png@{point[0]},{point[1]}", "cam0/01.png"]
    assert read_capture(rig, CaptureConfig(scale=ScaleConfig(between=between, distance=2))).metric
    depth = room_views(K, 64, 48)[7].depth
    (rig / "depth/cam1").mkdir(parents=True)
    np.save(rig / "depth/cam1/02.npy", (1000 * depth).astype(np.float32))
    capture = read_capture(rig, CaptureConfig(scale=ScaleConfig(depth_folder="depth")))
    np.testing.assert_allclose(capture.frame(7).depth, depth, rtol=1e-5)
    assert capture.load_depth(2) is None


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (
            ScaleConfig(between=["00.png", "xx.png"], distance=1),
            "no registered image is called 'xx.png'",
        ),
        (ScaleConfig(between=["00.png", "00.png"], distance=1), "are the same point"),
        (ScaleConfig(between=["00.png@900,1", "00.png"], distance=1), "no registered point within"),
        (ScaleConfig(between=["00.png@9", "00.png"], distance=1), "does not end in a pixel"),
        (ScaleConfig(between=["00.png", "01.png"]), "scale.between and scale.distance must be two"),
        (ScaleConfig(camera_height=1, factor=1), "given once, got scale.factor and scale.cam"),
        (ScaleConfig(camera_height=-1), "camera_height must be in \\[0, inf\\) m, got -1"),
        (ScaleConfig(depth_folder="nothing"), "0 points have a measured depth"),
    ],
)
def test_invalid_scale_is_refused(model, scale, message):
    with pytest.raises(ValueError, match=message):
        read_capture(model, CaptureConfig(scale=scale))


def test_distorted_model(model, K, shows_room, room_poses, trace_rays):
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    camera = reconstruction.cameras[1]
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [50.0, 31.0, 25.0, -0.12]
    reconstruction.write(model / "sparse/0")
    v, u = np.mgrid[0:48, 0:64] + 0.5
    K = np.array([[50.0, 0, 31], [0, 50, 25], [0, 0, 1]])
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-12)
    rays = cv2.undistortPoints(pixels, K, np.array([-0.12, 0, 0, 0]), criteria=criteria)
    for i, X_WC in enumerate(room_poses):
        view = trace_rays(X_WC, rays.reshape(48, 64, 2))
        cv2.imwrite(str(model / f"images/{i:02d}.png"), view.image[..., ::-1])
    capture = read_capture(model, CaptureConfig(scale=ScaleConfig(factor=1 / SHRINK)))
    shows_room(capture, room_poses[0] @ capture.X_WCs[0].inverse(), color=3.0, depth=None)


def test_missing_parts(model):
    (model / "images").rename(model / "elsewhere")
    with pytest.raises(FileNotFoundError, match="none of the model's images"):
        read_capture(model)
    (model / "sparse/0/images.bin").unlink()
    (model / "sparse/0/images.txt").write_text("1234")
    (model / "sparse/0/cameras.txt").write_text("1 PINHOLE 64")
    with pytest.raises(ValueError, match="not a readable COLMAP model"):
        read_capture(model)


def test_points_at_invalid_positions_are_left_out(model):
    before = read_capture(model).points
    reconstruction = pycolmap.Reconstruction(model / "sparse" / "0")
    next(iter(reconstruction.points3D.values())).xyz = [0, 1e300, 0]
    reconstruction.write(model / "sparse" / "0")
    after = read_capture(model).points
    assert before is not None and after is not None
    assert len(after.p_WQ) == len(before.p_WQ) - 1


def test_image_name_in_another_encoding_is_refused(model):
    pycolmap.Reconstruction(model / "sparse" / "0").write_text(model / "sparse" / "0")
    for file in (model / "sparse" / "0").glob("*.bin"):
        file.unlink()
    listed = model / "sparse/0/images.txt"
    listed.write_bytes(listed.read_bytes().replace(b"03.png", b"\xb5.png"))
    with pytest.raises(ValueError, match=r"sparse/0: not a readable COLMAP model \(.*utf-8"):
        read_capture(model)


def test_photographs_are_registered_once(model, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    (model / "sparse/0").rename(cache / "model")
    cv2.imwrite(str(model / "images/blank.png"), np.zeros((48, 64, 3), np.uint8))
    (model / "images/empty.jpg").write_bytes(b"")
    capture = read_capture(model, CaptureConfig(cache=str(cache)))
    assert len(capture) == 10 and not capture.metric
    assert "empty.jpg: not a readable image" in capture.dropped[0]
    assert "blank.png: not registered" in capture.dropped[1]


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_damaged_truncated_or_extended_model_is_refused(model, name):
    file = model / f"sparse/0/{name}.bin"
    content = file.read_bytes()
    for damaged in (b"\xff" * 8 + content[8:], content[:-1], content + b"\0"):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"sparse/0: not a readable COLMAP model"):
            read_capture(model)


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
