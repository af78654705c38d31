import json

import cv2
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig
from splatpilot.training.captures.read_capture import read_capture

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
DISTORTION = {"k1": -0.15, "k2": 0.03, "p1": 0.002, "p2": -0.001}


@pytest.fixture
def write(tmp_path, K, room_views, room_poses, trace_rays):
    """Writes the room for nerfstudio, with any camera and keys of its own."""

    def write(rays=None, depth=True, **extra):
        views = (
            room_views(K, 64, 48)
            if rays is None
            else [trace_rays(X_WC, rays) for X_WC in room_poses]
        )
        frames = []
        for i, view in enumerate(views):
            cv2.imwrite(str(tmp_path / f"{i:02d}.png"), view.image[..., ::-1])
            frame = {
                "file_path": f"./{i:02d}.png",
                "transform_matrix": (view.X_WC.GetAsMatrix4() @ OPENGL).tolist(),
            }
            if depth:
                np.save(tmp_path / f"{i:02d}.npy", (1000 * view.depth).astype(np.float32))
                frame["depth_file_path"] = f"{i:02d}.npy"
            frames.append(frame)
        camera = {"w": 64, "h": 48, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        content = camera | extra | {"frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


def test_room(write, shows_room):
    """Camera axes are OpenGL's, depth is in thousandths."""
    capture = read_capture(write())
    assert capture.metric and capture.depth_camera is None
    shows_room(capture, color=0.5)


def test_distortion_is_taken_out(write, K, shows_room):
    """Images and depth of a distorted camera become those of a pinhole."""
    v, u = np.mgrid[0:48, 0:64] + 0.5
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    coefficients = np.array([DISTORTION[name] for name in ("k1", "k2", "p1", "p2")])
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-12)
    rays = cv2.undistortPoints(pixels, K, coefficients, criteria=criteria)
    path = write(rays.reshape(48, 64, 2), camera_model="OPENCV", **DISTORTION)
    capture = read_capture(path)
    assert capture.K[0, 0] == K[0, 0]
    shows_room(capture, color=3.0, depth=0.02)
    # Taken for a pinhole, the same files show another room.
    content = json.loads((path / "transforms.json").read_text()) | dict.fromkeys(DISTORTION, 0)
    (path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(AssertionError):
        shows_room(read_capture(path), color=3.0, depth=0.02)


def test_edges_of_undistorted_images_are_not_dark(write, K):
    """At the edges of the pinhole's images is what the lens sees there, and nothing black."""
    path = write(camera_model="OPENCV", k1=0.02)
    for i in range(10):
        cv2.imwrite(str(path / f"{i:02d}.png"), np.full((48, 64, 3), 200, np.uint8))
    assert (read_capture(path).frame(0).image == 200).all()


def test_fisheye(write, K, shows_room):
    """An equidistant fisheye becomes a pinhole."""
    v, u = np.mgrid[0:48, 0:64] + 0.5
    bent = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)
    theta = np.linalg.norm(bent, axis=-1, keepdims=True)
    path = write(bent * np.tan(theta) / theta, camera_model="OPENCV_FISHEYE")
    shows_room(read_capture(path), color=3.0, depth=0.02)


def test_each_frame_may_have_its_camera(write, shows_room):
    """Frames with intrinsics of their own are resampled into one pinhole."""
    path = write()
    content = json.loads((path / "transforms.json").read_text())
    for name in ("cx", "cy"):
        content["frames"][3][name] = content[name] + 4
    image = cv2.imread(str(path / "03.png"))
    shift = np.float32([[1, 0, 4], [0, 1, 4]])
    cv2.imwrite(str(path / "03.png"), cv2.warpAffine(image, shift, (64, 48)))
    depth = np.load(path / "03.npy")
    np.save(path / "03.npy", cv2.warpAffine(depth, shift, (64, 48)))
    (path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(path)
    assert not capture.dropped and capture.K[0, 0] > 50
    shows_room(capture, color=4.0, depth=0.02)


def test_small_depth(write, shows_room, room_views, K):
    """Depth of a lower resolution than the images is carried into their pixels."""
    path = write()
    for i, view in enumerate(room_views(np.diag([0.5, 0.5, 1]) @ K, 32, 24)):
        np.save(path / f"{i:02d}.npy", (1000 * view.depth).astype(np.float32))
    capture = read_capture(path)
    assert capture.frame(0).depth.shape == (48, 64)
    shows_room(capture, color=0.5, depth=0.03)


def test_depth_of_another_view_is_refused(write, room_views, K):
    """Depth whose ratio of width to height is not the images' cannot show what they show."""
    path = write()
    for i in range(10):
        np.save(path / f"{i:02d}.npy", np.ones((24, 24), np.float32))
    with pytest.raises(ValueError, match="24x24 pixels of depth do not show what 64x48 pixels"):
        read_capture(path)


def test_scale(write, room_poses):
    """Without depth the scale is unknown, until two cameras' distance is given."""
    path = write(depth=False)
    capture = read_capture(path)
    assert not capture.metric and not capture.has_depth
    scale = ScaleConfig(between=["00.png", "09.png"], distance=10.0)
    scaled = read_capture(path, CaptureConfig(scale=scale))
    assert scaled.metric
    p = [X_WC.translation() for X_WC in scaled.X_WCs]
    assert np.linalg.norm(p[9] - p[0]) == pytest.approx(10)
    ratio = np.linalg.norm(p[5] - p[2]) / 10
    q = [X_WC.translation() for X_WC in room_poses]
    assert ratio == pytest.approx(np.linalg.norm(q[5] - q[2]) / np.linalg.norm(q[9] - q[0]))


def test_points(write):
    """Points of a PLY are read with their colours."""
    path = write(ply_file_path="points.ply")
    rows = [(1.0, 2.0, 3.0, 255, 0, 51)]
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = PlyElement.describe(np.array(rows, dtype=kinds), "vertex")
    PlyData([vertices]).write(str(path / "points.ply"))
    points = read_capture(path).points
    assert points is not None
    np.testing.assert_allclose(points.p_WQ, [[1, 2, 3]])
    np.testing.assert_allclose(points.colors, [[1, 0, 0.2]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model is EQUIRECTANGULAR; known are"),
        ({"fl_x": "wide"}, r"transforms\.json: the camera of 00\.png is not described"),
        ({"frames": 3}, r"transforms\.json: not nerfstudio's format"),
        ({"frames": [{"file_path": "00.png"}]}, r"transforms\.json: .*transform_matrix"),
        ({"ply_file_path": "00.png"}, r"00\.png: not a PLY of coloured points"),
        ({"ply_file_path": 3}, r"transforms\.json: .*3 stands where a path belongs"),
        ({"depth_unit_scale_factor": 0}, r"transforms\.json: .*depth_unit_scale_factor is 0"),
        ({"depth_unit_scale_factor": None}, r"transforms\.json: not nerfstudio's format"),
        ({"depth_unit_scale_factor": -1}, r"transforms\.json: .*depth_unit_scale_factor is -1"),
        ({"depth_unit_scale_factor": np.nan}, r"transforms\.json: .*scale_factor is nan"),
        ({"w": np.inf}, r"transforms\.json: the camera of 00\.png .*infinity"),
        ({"w": 10**9}, r"transforms\.json: the camera of .*images of 1000000000x48 pixels"),
        ({"fl_x": -40}, r"transforms\.json: the camera of 00\.png .*focal lengths of \[-40"),
        ({"fl_x": 1e300}, r"transforms\.json: the camera of 00\.png .*focal lengths of \[1e\+300"),
        ({"fl_x": np.nan}, r"transforms\.json: the camera of 00\.png .*focal lengths of \[nan"),
        ({"cx": np.nan}, r"transforms\.json: the camera of 00\.png .*principal point of \[nan"),
        ({"k1": np.nan}, r"transforms\.json: the camera of 00\.png .*distortion"),
    ],
)
def test_bad_transforms(write, change, message):
    """What is wrong in the file is said."""
    path = write()
    content = json.loads((path / "transforms.json").read_text()) | change
    (path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_capture(path)


def test_nesting_without_end(write):
    """Brackets in brackets are refused by file, however many."""
    path = write()
    (path / "transforms.json").write_text('{"frames": ' + "[" * 10**5 + "]" * 10**5 + "}")
    with pytest.raises(ValueError, match=r"transforms\.json: not nerfstudio's format"):
        read_capture(path)


@pytest.mark.parametrize(
    "depth",
    [
        np.full((48, 64), 1 + 1j),
        np.full((48, 64), np.datetime64("2026-01-01")),
        np.ones((48, 64), bool),
        b"\x93NUMPY\x01\x00G\x00{'descr': '<f4', 'fortran_order': False, 'shape': (99999, 99999)}",
        b"\x93NUMPY\x01\x00\xff\xff nonsense",
    ],
)
def test_bad_depth_drops_its_frame(write, depth):
    """A depth that is none, or whose header claims what is not there, drops its own frame only."""
    path = write()
    if isinstance(depth, bytes):
        (path / "03.npy").write_bytes(depth)
    else:
        np.save(path / "03.npy", depth)
    capture = read_capture(path)
    assert len(capture) == 9 and "03.npy" in capture.dropped[0]


def test_bad_matrix_is_left_out(write):
    """A frame whose matrix is none is left out and named."""
    path = write()
    content = json.loads((path / "transforms.json").read_text())
    content["frames"][2]["transform_matrix"] = [[1, 2], [3, 4]]
    (path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(path)
    assert len(capture) == 9 and "frame 2 (./02.png): transform_matrix" in capture.dropped[0]


def test_depth_name_that_no_file_system_takes(write):
    """A frame whose depth has a name of 5000 letters is left out, and told shortened."""
    path = write()
    content = json.loads((path / "transforms.json").read_text())
    content["frames"][0]["depth_file_path"] = "n" * 5000
    (path / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(path)
    assert len(capture) == 9
    assert "File name too long" in capture.dropped[0] and len(capture.dropped[0]) < 1000
