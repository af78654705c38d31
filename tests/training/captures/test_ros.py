import os
import struct

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import K, assert_shows_room, room_views
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.ros import TransformTree

START = 1_600_000_000.0
FRAME = "camera_color_optical_frame"
# The camera on the body: ahead, and in optical axes.
X_BC = RigidTransform(RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])), [0.2, 0, 0])


class Bag:
    """A bag of the room, to which each method adds messages."""

    def __init__(self, folder, version: int, K, views):
        self.path = folder / ("room.bag" if version == 1 else "room")
        self._one = version == 1
        self._store = get_typestore(Stores.ROS1_NOETIC if self._one else Stores.ROS2_HUMBLE)
        if self._one:  # which has no type of `tf2` built in
            types = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(types, "tf2_msgs/msg/TFMessage"))
        self._writer = Writer1(self.path) if self._one else Writer2(self.path, version=8)
        self._writer.open()
        self._connections: dict = {}
        self.K, self.views = K, views

    def message(self, name: str, *values):
        return self._store.types[name](*values)

    def header(self, time: float, frame: str):
        seconds = int(time)
        stamp = self.message("builtin_interfaces/msg/Time", seconds, round(1e9 * (time - seconds)))
        sequence = [0] if self._one else []
        return self.message("std_msgs/msg/Header", *sequence, stamp, frame)

    def write(self, topic: str, kind: str, time: float, frame: str, *values) -> None:
        if topic not in self._connections:
            connection = self._writer.add_connection(topic, kind, typestore=self._store)
            self._connections[topic] = connection
        serialize = self._store.serialize_ros1 if self._one else self._store.serialize_cdr
        first = [self.header(time, frame)] if frame else []
        raw = serialize(self.message(kind, *first, *values), kind)
        self._writer.write(self._connections[topic], int(1e9 * time), raw)

    def images(self, compressed=False, depth32=False, plain=False, color="/color") -> None:
        for i, view in enumerate(self.views):
            time, depth = START + i / 30, view.depth.astype(np.float32)
            millimeters = np.round(1000 * depth).astype(np.uint16)
            if compressed:
                kind = "sensor_msgs/msg/CompressedImage"
                png = cv2.imencode(".png", view.image[..., ::-1])[1].ravel()
                text = "bgr8; png compressed bgr8"
                self.write(f"{color}/compressed", kind, time, FRAME, text, png)
                a, b = 2000.0, 100.0
                stored = np.round(a / depth + b).astype(np.uint16) if depth32 else millimeters
                parameters = np.frombuffer(struct.pack("<iff", 0, a, b), np.uint8)
                packed = np.concatenate([parameters, cv2.imencode(".png", stored)[1].ravel()])
                text = f"{'32FC1' if depth32 else '16UC1'}; compressedDepth"
                if plain:  # as the transport "compressed" writes depth
                    packed, text = packed[12:], "16UC1; png compressed "
                self.write("/depth/compressedDepth", kind, time + 0.004, FRAME, text, packed)
                continue
            padded = np.zeros((48, 66, 3), np.uint8)  # rows of 6 bytes more
            padded[:, :64] = view.image[..., ::-1]
            stored, text = (depth, "32FC1") if depth32 else (millimeters, "16UC1")
            for topic, encoding, pixels in ((color, "bgr8", padded), ("/depth", text, stored)):
                data = pixels.view(np.uint8).reshape(48, -1)
                values = 48, 64, encoding, 0, data.shape[1], data.ravel()
                self.write(topic, "sensor_msgs/msg/Image", time, FRAME, *values)

    def calibration(self, model="plumb_bob", topic="/info", scale=1.0, rectified=False) -> None:
        matrix = np.array(self.K)
        matrix[:2, 2] -= 0.5
        matrix[[0, 1], [0, 1]] *= scale
        P, d = np.zeros((3, 4)), np.zeros(5)
        if rectified:
            P[:, :3], matrix = matrix, np.diag([0.9, 0.9, 1]) @ matrix
            d[0] = -0.25
        roi = self.message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        arrays = d, matrix.ravel(), np.eye(3).ravel(), P.ravel()
        values = 48, 64, model, *arrays, 0, 0, roi
        self.write(topic, "sensor_msgs/msg/CameraInfo", START, FRAME, *values)

    def pose(self, kind: str, vector: str, X: RigidTransform):
        w, x, y, z = X.rotation().ToQuaternion().wxyz()
        p = self.message(f"geometry_msgs/msg/{vector}", *X.translation())
        q = self.message("geometry_msgs/msg/Quaternion", x, y, z, w)
        return self.message(f"geometry_msgs/msg/{kind}", p, q)

    def transform(self, topic: str, time: float, parent: str, child: str, X: RigidTransform):
        stamped = self.header(time, parent), child, self.pose("Transform", "Vector3", X)
        stamped = self.message("geometry_msgs/msg/TransformStamped", *stamped)
        self.write(topic, "tf2_msgs/msg/TFMessage", time, "", [stamped])

    def moving(self):
        for i, view in enumerate(self.views):
            X_WB = view.X_WC @ X_BC.inverse()
            for offset in (-0.005, 0.005):
                ahead = np.array([100 * offset, 0, 0])
                X = RigidTransform(X_WB.rotation(), X_WB.translation() + ahead)
                yield START + i / 30 + offset, X

    def odometry(self, topic: str = "/odom") -> None:
        still = self.message("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.message("geometry_msgs/msg/Twist", still, still)
        twist = self.message("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        for time, X in self.moving():
            pose = self.pose("Pose", "Point", X), np.zeros(36)
            pose = self.message("geometry_msgs/msg/PoseWithCovariance", *pose)
            self.write(topic, "nav_msgs/msg/Odometry", time, "odom", "base_link", pose, twist)

    def room(self, calibrations=({},), poses: str = "odometry", **images):
        self.images(**images)
        for calibration in calibrations:
            self.calibration(**calibration)
        self.transform("/tf_static", START, "base_link", FRAME, X_BC)
        if poses == "odometry":
            self.odometry()
        else:
            for time, X in self.moving():
                self.transform("/tf", time, "odom", "base_link", X)
        return self.close()

    def close(self):
        self._writer.close()
        return self.path


@pytest.fixture
def bag(tmp_path):
    return lambda version: Bag(tmp_path, version, K, room_views(K, 64, 48))


@pytest.fixture
def config(tmp_path):
    return lambda **changes: CaptureConfig(cache=str(tmp_path / "cache"), **changes)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("poses", "images"),
    [
        ("odometry", {}),
        ("transforms", {}),
        ("odometry", {"compressed": True}),
        ("odometry", {"compressed": True, "depth32": True}),
        ("odometry", {"compressed": True, "plain": True}),
    ],
)
def test_room(bag, config, version, poses, images):
    capture = read_capture(bag(version).room(poses=poses, **images), config())
    assert capture.source.startswith("ROS bag") and len(capture) == 10 and not capture.dropped
    assert_shows_room(capture, color=0.5, depth=0.01 if images else 0.002)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("calibrations", "color", "note"),
    [
        ([{"topic": "/camera/camera_info", "rectified": True}], "/camera/image_rect_color",
         "from /camera/camera_info, P without distortion"),
        ([{"topic": "/camera/aligned/camera_info", "scale": 1.3},
          {"topic": "/camera/color/camera_info"}], "/camera/color/image_raw",
         "from /camera/color/camera_info"),
    ],
)  # fmt: skip
def test_calibration_is_of_the_images(bag, config, compressed, calibrations, color, note):
    recorded = bag(1)
    path = recorded.room(calibrations, compressed=compressed, color=color)
    capture = read_capture(path, config())
    np.testing.assert_allclose(capture.K, recorded.K)
    assert capture.notes[0].endswith(note)
    assert_shows_room(capture, color=0.5, depth=0.01)


@pytest.mark.parametrize(
    ("calibrations", "problem"),
    [
        ([{"topic": "/a/info", "scale": 1.3}, {"topic": "/b/info"}],
         "/a/info, /b/info differ, and none is next to /camera/color"),
        ([{"model": "omnidirectional"}], "/info has the distortion 'omnidirectional'"),
    ],
)  # fmt: skip
def test_intrinsics_replace_an_ambiguous_or_unknown_calibration(bag, config, calibrations, problem):
    path = bag(1).room(calibrations, color="/camera/color")
    with pytest.raises(ValueError, match=f"{problem}.*; set capture.intrinsics"):
        read_capture(path, config())
    assert read_capture(path, config(intrinsics=[50, 52, 31, 25])).K[0, 0] == 50


def test_the_bag_is_read_once(bag, config):
    recorded = bag(2)
    path = recorded.room((), depth32=True)
    with pytest.raises(ValueError, match=r"has no calibration of the color camera.*intrinsics"):
        read_capture(path, config())
    database = next(path.glob("*.db3"))
    size, times = database.stat().st_size, database.stat()
    database.write_bytes(bytes(size))
    os.utime(database, ns=(times.st_atime_ns, times.st_mtime_ns))
    K = recorded.K
    capture = read_capture(path, config(intrinsics=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    assert_shows_room(capture, color=0.5, depth=0.002)


def test_missing_parts_are_named(bag, config, tmp_path):
    (tmp_path / "damaged.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(ValueError, match=r"damaged\.bag: not a readable ROS bag"):
        read_capture(tmp_path / "damaged.bag", config())
    recorded = bag(1)
    recorded.images()
    with pytest.raises(ValueError, match=r"has no topic of poses; it has /color, /depth"):
        read_capture(recorded.close(), config())
    recorded.path.unlink()
    recorded = bag(1)
    recorded.images()
    recorded.calibration()
    recorded.transform("/tf", START + 9.0, "odom", FRAME, X_BC)
    path = recorded.close()
    for _ in range(2):
        with pytest.raises(ValueError, match=rf"poses of '{FRAME}', the frame of /color, in /tf"):
            read_capture(path, config())
    path.unlink()
    recorded = bag(1)
    recorded.images()
    recorded.calibration()
    recorded.transform("/tf_static", START, "camera_link", FRAME, X_BC)
    for time, X in recorded.moving():
        recorded.transform("/tf", time, "odom", "base_link", X)
    with pytest.raises(ValueError, match=r"in /tf must be at least 2, got 0; record all trans"):
        read_capture(recorded.close(), config())
    two = bag(2)
    two.images()
    two.calibration()
    two.odometry()
    two.odometry("/slam")
    path = two.close()
    with pytest.raises(ValueError, match=r"poses are in /odom, /slam; set capture\.topics"):
        read_capture(path, config())
    with pytest.raises(ValueError, match=r"has no topic /vicon; it has /color, /depth"):
        read_capture(path, config(topics=["/color", "/depth", "/vicon"]))
    with pytest.raises(ValueError, match=r"poses, /color, must be of .*Odometry.*, got .*Image"):
        read_capture(path, config(topics=["/color", "/depth", "/color"]))
    # Nothing says where on the body the camera is.
    condition = f"connected by /tf_static with '{FRAME}', of /color, got no transform"
    with pytest.raises(ValueError, match=f"'base_link', .* in /slam, must be {condition}"):
        read_capture(path, config(topics=["/color", "/depth", "/slam"]))
    with pytest.raises(ValueError, match=r"a part of a bag; name its folder"):
        read_capture(next(path.glob("*.db3")), config())


def rotated(angle: float, x: float = 0.0) -> RigidTransform:
    return RigidTransform(RotationMatrix.MakeZRotation(angle), [x, 0, 0])


STILL = rotated(0.0)


def test_poses_are_composed_and_interpolated():
    tree = TransformTree()
    tree.fix("body", "camera", rotated(0.0, 1.0))
    tree.move("map", "body", 10.1, rotated(0.4, 4.0))
    tree.move("map", "body", 10.0, rotated(0.2, 2.0))  # later in the bag
    for time, X_WB in ((10.05, rotated(0.3, 3.0)), (10.1, rotated(0.4, 4.0))):
        assert tree.pose("camera", time).IsNearlyEqualTo(X_WB @ rotated(0.0, 1.0), 1e-9)
    assert tree.pose("body", 9.5) is None
    tree.fix("desk", "lamp", STILL)
    assert tree.pose("lamp", 10.05) is None and tree.pose("chair", 10.05) is None
    tree.move("map", "body", 12.0, STILL)
    assert tree.pose("body", 11.0) is None  # between samples that are too far apart
    tree.fix("b", "a", STILL)
    tree.fix("a", "b", STILL)
    assert tree.pose("a", 1.0) is None


def test_fixed_poses():
    tree = TransformTree()
    tree.fix("body", "mast", rotated(0.1, 1.0))
    tree.fix("mast", "camera", rotated(0.1, 1.0))
    tree.move("map", "body", 1.0, STILL)
    expected = rotated(0.1, 1.0) @ rotated(0.1, 1.0)
    assert tree.fixed_pose("body", "camera").IsNearlyEqualTo(expected, 1e-12)
    assert tree.fixed_pose("map", "camera") is None and tree.fixed_pose("lamp", "camera") is None
    assert tree.fixed_pose("camera", "camera").IsNearlyEqualTo(STILL, 0)
