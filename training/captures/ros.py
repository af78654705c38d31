"""ROS bags, of ROS 1 (`.bag`) or ROS 2 (a folder with `metadata.yaml`), as RGB-D sequences.

A bag has topics of color images, of depth images in their pixels (16UC1 in millimeters or 32FC1 in
meters), of the calibration of the color camera, and of poses: the only topic of `_POSES`, of the
body that `child_frame_id` may name, moved to the frame of the images by `/tf_static`, or else
`/tf`, from its root to that frame. All is written to the cache once, in TUM's format.
"""

import json
import struct
from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.readers import readable
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.state import pose_between
from splatpilot.training.captures.capture import (
    Capture,
    Lens,
    centered_pinhole,
    fisheye_lens,
    opencv_lens,
)
from splatpilot.training.captures.capture_config import (
    CaptureConfig,
    cache_folder,
    cache_key,
    cached_folder,
)
from splatpilot.training.captures.frames import pose_from_quaternion, pose_row
from splatpilot.training.captures.tum import MAX_GAP, open_sequence

_COLORS = {"rgb8": -1, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB}
_COLORS |= {"bgra8": cv2.COLOR_BGRA2RGB, "mono8": cv2.COLOR_GRAY2RGB}
_DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
_DEPTH_UNIT = 1000.0  # units per meter of the depth that is written
_METADATA = "metadata.yaml"
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
_TF = "tf2_msgs/msg/TFMessage"
_POSES = {
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
}
_TRANSPORTS = ("/compressed", "/compressedDepth", "/theora")
_CAMERA = "camera.json"
_VERSION = 4  # version of the cache's content; others are written again
_MODELS = {"": opencv_lens, "plumb_bob": opencv_lens, "rational_polynomial": opencv_lens}
_MODELS |= {"equidistant": fisheye_lens, "fisheye": fisheye_lens}


def recognizes(path: Path) -> bool:
    """Tells whether a path looks like a bag."""
    if path.suffix in {".bag", ".db3", ".mcap"}:
        return True
    file = path / _METADATA
    return file.is_file() and b"rosbag2_bagfile_information" in file.read_bytes()[:4096]


def read(path: Path, config: CaptureConfig) -> Capture:
    """Opens a bag, of `config.topics` and `config.intrinsics` if given."""
    if path.suffix in {".db3", ".mcap"}:
        raise ValueError(f"{path}: a part of a bag; name its folder, which holds {_METADATA}")
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    key = cache_key(files, config.topics, _VERSION)

    def write(written: Path) -> None:
        with closing(_open(path)) as reader:
            _Bag(path, reader, config.topics).write(written)

    folder = cached_folder(cache_folder(config, "bags", key) / path.stem, write)
    camera = json.loads((folder / _CAMERA).read_text())

    def lens(width: int, height: int) -> Lens:
        if "problem" in camera:
            raise ValueError(
                f"{path}: {camera['problem']}; set capture.intrinsics to [fx, fy, cx, cy] of "
                "images without distortion"
            )
        K, make = centered_pinhole(*camera["intrinsics"]), _MODELS[camera["model"]]
        own = make(K, camera["width"], camera["height"], camera["distortion"])
        return replace(own, source=camera["source"]).scale_to(width, height)

    return open_sequence(folder, "ROS bag", config, lens, _DEPTH_UNIT)


def _open(path: Path) -> Any:
    highlevel: Any = import_extra("rosbags.highlevel", "ros")
    typesys: Any = import_extra("rosbags.typesys", "ros")
    with readable(path, "ROS bag"):
        types = typesys.get_typestore(typesys.Stores.LATEST)
        reader = highlevel.AnyReader([path], default_typestore=types)
        reader.open()
    return reader


class _Bag:
    def __init__(self, path: Path, reader: Any, topics: list[str]):
        self._path, self._reader = path, reader
        self._types = {c.topic: c.msgtype for c in reader.connections}
        shown: dict[str, list[str]] = {"color": [], "depth": [], "": []}
        for topic in self._topics(*_IMAGES):
            shown[self._content(topic)].append(topic)
        poses = self._topics(*_POSES) or [t for t in self._topics(_TF) if t != "/tf_static"]
        given = topics or ["", "", ""]
        self._color = self._choose("color images", shown["color"], given[0], _IMAGES)
        self._depth = self._choose("depth images", shown["depth"], given[1], _IMAGES)
        self._pose = self._choose("poses", poses, given[2], (*_POSES, _TF))

    def write(self, folder: Path) -> None:
        """Writes images, lists of times and poses, and the calibration."""
        tree, frame = self._transforms(), _frame(self._first(self._color))
        colors, poses = self._write_images(folder, "rgb", self._color, _encode_color), []
        self._write_images(folder, "depth", self._depth, _encode_depth)
        if self._types[self._pose] == _TF:
            found = ((time, tree.pose(frame, time)) for time in colors)
            poses = [(time, X_WC) for time, X_WC in found if X_WC is not None]
        else:
            pose_field = _POSES[self._types[self._pose]]
            for message in self._messages(self._pose):
                body = getattr(message, "child_frame_id", "").lstrip("/")
                X_BC = tree.fixed_pose(body, frame) if body else RigidTransform()
                if X_BC is None:
                    raise ValueError(
                        f"{self._path}: {body!r}, whose poses are in {self._pose}, must be "
                        f"connected by /tf_static with {frame!r}, of {self._color}, got no "
                        "transform; record it in the bag"
                    )
                poses.append((_time(message), _pose(pose_field(message), self._pose) @ X_BC))
        what = f"{self._path}: poses of {frame!r}, the frame of {self._color}, in {self._pose}"
        remedy = f"record all transforms between {frame!r} and a frame that moves"
        require(len(poses) >= 2, what, "at least 2", len(poses), remedy)
        lines = [f"{time:.9f} {pose_row(X_WC)}\n" for time, X_WC in poses]
        (folder / "groundtruth.txt").write_text("".join(lines))
        (folder / _CAMERA).write_text(json.dumps(self._calibration(frame)))

    def _topics(self, *types: str) -> list[str]:
        return sorted(topic for topic, each in self._types.items() if each in types)

    def _choose(self, what: str, topics: list[str], given: str, types: Collection[str]) -> str:
        if given in self._types:
            found = self._types[given] if self._first(given) else "no message"
            kinds = f"of {' or '.join(types)}"
            require(found in types, f"{self._path}: {what}, {given},", kinds, found)
            return given
        if given or not topics:
            missing = given or f"of {what}"
            known = ", ".join(sorted(self._types))
            raise ValueError(f"{self._path}: has no topic {missing}; it has {known}")
        if len(topics) > 1:
            raise ValueError(
                f"{self._path}: {what} are in {', '.join(topics)}; set capture.topics to the names "
                "of color, depth and poses"
            )
        return topics[0]

    def _content(self, topic: str) -> str:
        """Returns "color", "depth" or, for other images, ""."""
        message = self._first(topic)
        if message is None:
            return ""
        if hasattr(message, "format"):
            is_depth = "compressedDepth" in message.format or message.format.startswith("16UC1")
            return "depth" if is_depth else "color"
        if message.encoding in _DEPTHS:
            return "depth"
        return "color" if message.encoding in _COLORS else ""

    def _messages(self, *topics: str) -> Iterator[Any]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        for connection, _, raw in self._reader.messages(connections=connections):
            yield self._reader.deserialize(raw, connection.msgtype)

    def _first(self, topic: str) -> Any:
        return next(self._messages(topic), None)

    def _transforms(self) -> "TransformTree":
        tree = TransformTree()
        for topic in self._topics(_TF):
            for message in self._messages(topic):
                for moved in message.transforms:
                    parent, child = _frame(moved), moved.child_frame_id.lstrip("/")
                    if topic == "/tf_static":
                        tree.fix(parent, child, _pose(moved.transform, topic))
                    else:
                        tree.move(parent, child, _time(moved), _pose(moved.transform, topic))
        return tree

    def _write_images(
        self, folder: Path, name: str, topic: str, encode: Callable[[Any], tuple[str, bytes]]
    ) -> list[float]:
        """Writes the images of a topic and the list of their times, which it returns [s]."""
        (folder / name).mkdir()
        count = sum(c.msgcount for c in self._reader.connections if c.topic == topic)
        times = []
        with (folder / f"{name}.txt").open("w") as file:
            for message in Progress(self._messages(topic), topic, count, unit="image"):
                times.append(_time(message))
                with readable(self._path, f"bag at {times[-1]:.3f} s of {topic}"):
                    suffix, content = encode(message)
                image = f"{name}/{times[-1]:.9f}.{suffix}"
                (folder / image).write_bytes(content)
                file.write(f"{times[-1]:.9f} {image}\n")
        if not any(times):
            raise ValueError(
                f"{self._path}: header stamps of {topic} are 0; write the times of recording there"
            )
        return times

    def _calibration(self, frame: str) -> dict[str, Any]:
        """Returns the calibration in the namespace of the color images or else of their `frame`, or
        the problem. K and D describe images as taken, P rectified ones (CameraInfo)."""
        images = self._color
        for transport in _TRANSPORTS:
            images = images.removesuffix(transport)
        namespace, _, image = images.rpartition("/")
        infos = {topic: info for topic in self._topics(_INFO) if (info := self._first(topic))}
        near = [topic for topic in infos if topic.rpartition("/")[0] == namespace]
        found = near or [topic for topic, info in infos.items() if _frame(info) == frame]
        if not found:
            return {"problem": "has no calibration of the color camera (CameraInfo)"}
        topic, message = found[0], infos[found[0]]
        matrix, projection, distortion = (_info_field(message, name) for name in "kpd")
        if any(not np.array_equal(_info_field(infos[each], "k"), matrix) for each in found):
            return {"problem": f"{', '.join(found)} differ, and none is next to {self._color}"}
        K, model = np.asarray(matrix, dtype=float).reshape(3, 3), message.distortion_model
        if image.startswith("image_rect"):
            K, model, distortion = np.asarray(projection, dtype=float).reshape(3, 4), "", []
            topic += ", P without distortion"
        if model not in _MODELS:
            known = ", ".join(filter(None, _MODELS))
            return {"problem": f"{topic} has the distortion {model!r}; known are {known}"}
        return {
            "source": topic,
            "model": model,
            "intrinsics": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            "distortion": [float(d) for d in distortion],
            "width": int(message.width),
            "height": int(message.height),
        }


class TransformTree:
    """Frames by name, each with its parent, fixed in it or moving."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, RigidTransform] = {}
        self._moving: dict[str, list[tuple[float, RigidTransform]]] = {}

    def fix(self, parent: str, child: str, X_PC: RigidTransform) -> None:
        """Adds a fixed frame."""
        self._parents[child], self._fixed[child] = parent, X_PC

    def move(self, parent: str, child: str, time: float, X_PC: RigidTransform) -> None:
        """Adds the pose of a moving frame at a time [s]."""
        self._parents[child] = parent
        insort(self._moving.setdefault(child, []), (time, X_PC), key=itemgetter(0))

    def fixed_pose(self, ancestor: str, frame: str) -> RigidTransform | None:
        """Returns the pose of a frame in an ancestor, None unless all between them is fixed."""
        names = self._upwards(frame)
        if ancestor not in names:
            return None
        return _compose(map(self._fixed.get, names[: names.index(ancestor)]))

    def pose(self, frame: str, time: float) -> RigidTransform | None:
        """Returns the pose of a frame in its root at a time [s]; None if it is unknown then or if
        no frame in between moves."""
        *names, root = self._upwards(frame)
        if root in self._parents or self._moving.keys().isdisjoint(names):
            return None
        return _compose(self._fixed.get(name) or self._interpolate(name, time) for name in names)

    def _upwards(self, frame: str) -> list[str]:
        """Returns the frame, its parent, and so on, up to the root or a repetition."""
        names = [frame]
        while (parent := self._parents.get(names[-1])) is not None and parent not in names:
            names.append(parent)
        return names

    def _interpolate(self, child: str, time: float) -> RigidTransform | None:
        poses = self._moving[child]
        after = bisect_left(poses, time, key=itemgetter(0))
        if after < len(poses) and poses[after][0] == time:
            return poses[after][1]
        if not 0 < after < len(poses) or poses[after][0] - poses[after - 1][0] > MAX_GAP:
            return None
        (t0, a), (t1, b) = poses[after - 1], poses[after]
        return pose_between(a, b, (time - t0) / (t1 - t0))


def _compose(upwards: Iterable[RigidTransform | None]) -> RigidTransform | None:
    """Returns the pose of a frame from those of it and its ancestors, None if one is unknown."""
    X = RigidTransform()
    for each in upwards:
        if each is None:
            return None
        X = each @ X
    return X


def _encode_color(message: Any) -> tuple[str, bytes]:
    """Returns the suffix and content of a file of an `Image` or `CompressedImage`."""
    if hasattr(message, "format"):
        return "png" if "png" in message.format else "jpg", bytes(message.data)
    pixels = _pixels(message, np.uint8)
    if (code := _COLORS[message.encoding]) >= 0:
        pixels = cv2.cvtColor(pixels, code)
    return _encode_png(pixels[..., ::-1])


def _encode_depth(message: Any) -> tuple[str, bytes]:
    """Returns planar depth as a PNG of 16 bits in millimeters, 0 if unknown."""
    if hasattr(message, "format"):
        # compressedDepth: an enumeration, two floats and a PNG, which holds floats as 1 / depth.
        has_header = "compressedDepth" in message.format
        content = np.asarray(message.data[12 if has_header else 0 :], np.uint8)
        depth = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
        if depth is None:
            raise ValueError("no PNG")
        if has_header and "32FC1" in message.format:
            _, a, b = struct.unpack("<iff", bytes(message.data[:12]))
            inverse = depth.astype(np.float32) - np.float32(b)
            depth = np.where(depth > 0, np.float32(a) / np.maximum(inverse, 1e-6), 0)
    else:
        depth = _pixels(message, _DEPTHS[message.encoding])[..., 0]
    if depth.dtype != np.uint16:
        known = np.isfinite(depth) & (depth > 0) & (depth < 65.5)
        depth = np.round(_DEPTH_UNIT * np.where(known, depth, 0)).astype(np.uint16)
    return _encode_png(depth)


def _encode_png(pixels: NDArray) -> tuple[str, bytes]:
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return "png", cv2.imencode(".png", np.ascontiguousarray(pixels), options)[1].tobytes()


def _pixels(message: Any, dtype: type) -> NDArray:
    """Returns the pixels (H, W, C) of rows that may be padded."""
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    item = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    channels = rows.shape[1] // message.width // item.itemsize
    rows = np.ascontiguousarray(rows[:, : message.width * channels * item.itemsize])
    return rows.view(item).reshape(message.height, message.width, channels).astype(dtype)


def _info_field(info: Any, name: str) -> Any:
    """Returns a field of a CameraInfo, whose name is in capitals in ROS 1."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _frame(message: Any) -> str:
    return message.header.frame_id.lstrip("/")


def _time(message: Any) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec  # [s]


def _pose(message: Any, source: str) -> RigidTransform:
    p = getattr(message, "position", None) or message.translation
    q = getattr(message, "orientation", None) or message.rotation
    return pose_from_quaternion(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]), source)
