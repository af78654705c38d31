import os
import struct

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
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
    def __init__(self, folder, version: int, K, views):
        self.path = folder / ("room.bag" if version == 1 else "room")
        self._one = version == 1
        self._store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if version == 1:  # which has no type of `tf2` built in
            types = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(types, "tf2_msgs/msg/TFMessage"))
        self._writer = Writer1(self.path) if version == 1 else Writer2(self.path, version=8)
        self._writer.open()
        self._connections: dict = {}
        self.K, self.views = K, views

    def message(self, name: str, **fields):
        return self._store.types[name](**fields)

    def header(self, time: float, frame: str):
        seconds = int(time)
        nanoseconds = round(1e9 * (time - seconds))
        stamp = self.message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        extra = {"seq": 0} if self._one else {}
        return self.message("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def write(self, topic: str, kind: str, time: float, **fields) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store
            )
        serialize = self._store.serialize_ros1 if self._one else self._store.serialize_cdr
        raw = serialize(self.message(kind, **fields), kind)
        self._writer.write(self._connections[topic], int(1e9 * time), raw)

    def images(
        self, compressed: bool = False, depth32: bool = False, color: str = "/color"
    ) -> None:
        for i, view in enumerate(self.views):
            time = START + i / 30
            header = self.header(time, FRAME)
            depth = view.depth.astype(np.float32)
            millimeters = np.round(1000 * depth).astype(np.uint16)
            if compressed:
                png = cv2.imencode(".png", view.image[..., ::-1])[1]
                self.write(
                    f"{color}/compressed", "sensor_msgs/msg/CompressedImage", time,
                    header=header, format="bgr8; png compressed bgr8", data=png.ravel(),
                )  # fmt: skip
                a, b = 2000.0, 100.0
                stored = np.round(a / depth + b).astype(np.uint16) if depth32 else millimeters
                packed = cv2.imencode(".png", stored)[1].ravel()
                parameters = np.frombuffer(struct.pack("<iff", 0, a, b), np.uint8)
                kind = "32FC1" if depth32 else "16UC1"
                self.write(
                    "/depth/compressedDepth", "sensor_msgs/msg/CompressedImage", time + 0.004,
                    header=self.header(time + 0.004, FRAME),
                    format=f"{kind}; compressedDepth", data=np.concatenate([parameters, packed]),
                )  # fmt: skip
                continue
            height, width = depth.shape
            padded = np.zeros((height, width + 2, 3), np.uint8)  # rows of 8 bytes more
            padded[:, :width] = view.image[..., ::-1]
            for topic, encoding, pixels, step in (
                (color, "bgr8", padded, 3 * (width + 2)),
                ("/depth", "32FC1", depth, 4 * width) if depth32 else
                ("/depth", "16UC1", millimeters, 2 * width),
            ):  # fmt: skip
                self.write(
                    topic, "sensor_msgs/msg/Image", time, header=header, height=height,
                    width=width, encoding=encoding, is_bigendian=0, step=step,
                    data=np.ascontiguousarray(pixels).view(np.uint8).ravel(),
                )  # fmt: skip

    def calibration(
        self,
        model: str = "plumb_bob",
        topic: str = "/info",
        scale: float = 1.0,
        rectified: bool = False,
    ) -> None:
        matrix = np.array(self.K)
        matrix[:2, 2] -= 0.5
        matrix[[0, 1], [0, 1]] *= scale
        projection, distortion = np.zeros((3, 4)), np.zeros(5)
        if rectified:
            projection[:, :3], matrix = matrix, np.diag([0.9, 0.9, 1]) @ matrix
            distortion[0] = -0.25
        roi = self.message(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        names = "DKRP" if self._one else "dkrp"
        arrays = (distortion, matrix.ravel(), np.eye(3).ravel(), projection.ravel())
        self.write(
            topic, "sensor_msgs/msg/CameraInfo", START, header=self.header(START, FRAME),
            height=48, width=64, distortion_model=model, binning_x=0, binning_y=0, roi=roi,
            **dict(zip(names, arrays, strict=True)),
        )  # fmt: skip

    def _vector(self, kind: str, p):
        return self.message(f"geometry_msgs/msg/{kind}", x=p[0], y=p[1], z=p[2])

    def _quaternion(self, X: RigidTransform):
        w, x, y, z = X.rotation().ToQuaternion().wxyz()
        return self.message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(self, topic: str, time: float, parent: str, child: str, X: RigidTransform):
        moved = self.message(
            "geometry_msgs/msg/Transform",
            translation=self._vector("Vector3", X.translation()), rotation=self._quaternion(X),
        )  # fmt: skip
        stamped = self.message(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent), child_frame_id=child, transform=moved,
        )  # fmt: skip
        self.write(topic, "tf2_msgs/msg/TFMessage", time, transforms=[stamped])

    def moving(self):
        for i, view in enumerate(self.views):
            X_WB = view.X_WC @ X_BC.inverse()
            for offset in (-0.005, 0.005):
                ahead = np.array([100 * offset, 0, 0])
                X = RigidTransform(X_WB.rotation(), X_WB.translation() + ahead)
                yield START + i / 30 + offset, X

    def odometry(self, topic: str = "/odom") -> None:
        still = self._vector("Vector3", np.zeros(3))
        twist = self.message("geometry_msgs/msg/Twist", linear=still, angular=still)
        zero = {"covariance": np.zeros(36)}
        for time, X in self.moving():
            pose = self.message(
                "geometry_msgs/msg/Pose",
                position=self._vector("Point", X.translation()), orientation=self._quaternion(X),
            )  # fmt: skip
            self.write(
                topic, "nav_msgs/msg/Odometry", time,
                header=self.header(time, "odom"), child_frame_id="base_link",
                pose=self.message("geometry_msgs/msg/PoseWithCovariance", pose=pose, **zero),
                twist=self.message("geometry_msgs/msg/TwistWithCovariance", twist=twist, **zero),
            )  # fmt: skip

    def transforms(self) -> None:
        for time, X in self.moving():
            self.transform("/tf", time, "odom", "base_link", X)

    def room(self, calibrations=({},), poses: str = "odometry", **images):
        self.images(**images)
        for calibration in calibrations:
            self.calibration(**calibration)
        self.transform("/tf_static", START, "base_link", FRAME, X_BC)
        getattr(self, poses)()
        return self.close()

    def close(self):
        self._writer.close()
        return self.path


@pytest.fixture
def bag(tmp_path, K, room_views):
    def bag(version: int) -> Bag:
        return Bag(tmp_path, version, K, room_views(K, 64, 48))

    return bag


@pytest.fixture
def config(tmp_path):
    def config(**changes) -> CaptureConfig:
        return CaptureConfig(cache=str(tmp_path / "cache"), **changes)

    return config


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("poses", ["odometry", "transforms"])
def test_room(bag, config, shows_room, version, poses):
    capture = read_capture(bag(version).room(poses=poses), config())
    assert capture.source.startswith("ROS bag") and len(capture) == 10 and not capture.dropped
    shows_room(capture, color=0.5, depth=0.002)


@pytest.mark.parametrize("depth32", [False, True])
def test_compressed_images(bag, config, shows_room, depth32):
    path = bag(1).room(compressed=True, depth32=depth32)
    shows_room(read_capture(path, config()), color=0.5, depth=0.01)


@pytest.mark.parametrize("compressed", [False, True])
def test_rectified_images_are_described_by_the_projection(bag, config, shows_room, compressed):
    recorded = bag(1)
    calibration = {"topic": "/camera/camera_info", "rectified": True}
    path = recorded.room([calibration], compressed=compressed, color="/camera/image_rect_color")
    capture = read_capture(path, config())
    np.testing.assert_allclose(capture.K, recorded.K)
    assert capture.notes[0].endswith("from /camera/camera_info, P without distortion")
    shows_room(capture, color=0.5, depth=0.01)


@pytest.mark.parametrize("compressed", [False, True])
def test_calibration_is_in_the_namespace_of_the_images(bag, config, compressed):
    recorded = bag(1)
    calibrations = (
        {"topic": "/camera/aligned/camera_info", "scale": 1.3},
        {"topic": "/camera/color/camera_info"},
    )
    path = recorded.room(calibrations, compressed=compressed, color="/camera/color/image_raw")
    np.testing.assert_allclose(read_capture(path, config()).K, recorded.K)


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


def test_the_bag_is_read_once(bag, config, shows_room):
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
    shows_room(capture, color=0.5, depth=0.002)


def test_missing_parts_are_named(bag, config):
    recorded = bag(1)
    recorded.images()
    with pytest.raises(ValueError, match=r"has no topic of poses; it has /color, /depth"):
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
    capture = read_capture(path, config(topics=["/color", "/depth", "/slam"]))
    assert len(capture) == 10  # of the body: nothing says where on it the camera is
    with pytest.raises(ValueError, match=r"a part of a bag; name its folder"):
        read_capture(next(path.glob("*.db3")), config())


def test_no_pose_of_the_camera(bag, config):
    recorded = bag(1)
    recorded.images()
    recorded.calibration()
    recorded.transform("/tf", START + 9.0, "odom", FRAME, X_BC)
    path = recorded.close()
    for _ in range(2):
        with pytest.raises(ValueError, match=rf"poses of '{FRAME}', the frame of /color, in /tf"):
            read_capture(path, config())


def test_damaged_bag(tmp_path, config):
    path = tmp_path / "room.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(ValueError, match=r"room\.bag: not a readable ROS bag"):
        read_capture(path, config())


def rotated(angle: float, x: float = 0.0) -> RigidTransform:
    return RigidTransform(RotationMatrix.MakeZRotation(angle), [x, 0, 0])


def test_poses_are_composed_and_interpolated():
    tree = TransformTree()
    tree.fix("body", "camera", rotated(0.0, 1.0))
    tree.move("map", "body", 10.1, rotated(0.4, 4.0))
    tree.move("map", "body", 10.0, rotated(0.2, 2.0))  # later in the bag
    for time, X_WB in ((10.05, rotated(0.3, 3.0)), (10.1, rotated(0.4, 4.0))):
        pose = tree.pose("camera", time)
        assert pose is not None and pose.IsNearlyEqualTo(X_WB @ rotated(0.0, 1.0), 1e-9)


def test_unknown_poses():
    tree = TransformTree()
    for time in (1.0, 2.0):
        tree.move("map", "body", time, rotated(0.0))
    assert tree.pose("body", 0.5) is None and tree.pose("body", 1.5) is None
    alone = tree.pose("lamp", 1.0)
    assert alone is not None and alone.IsNearlyEqualTo(RigidTransform(), 0)
    tree.fix("b", "a", rotated(0.0))
    tree.fix("a", "b", rotated(0.0))
    assert tree.pose("a", 1.0) is None


def test_fixed_poses():
    tree = TransformTree()
    tree.fix("body", "mast", rotated(0.1, 1.0))
    tree.fix("mast", "camera", rotated(0.1, 1.0))
    tree.move("map", "body", 1.0, rotated(0.0))
    found = tree.fixed_pose("body", "camera")
    assert found is not None and found.IsNearlyEqualTo(rotated(0.1, 1.0) @ rotated(0.1, 1.0), 1e-12)
    assert tree.fixed_pose("map", "camera") is None and tree.fixed_pose("lamp", "camera") is None
    own = tree.fixed_pose("camera", "camera")
    assert own is not None and own.IsNearlyEqualTo(RigidTransform(), 0)
