"""RGB-D sequences in TUM's format: `rgb.txt`, `depth.txt`, `groundtruth.txt` with time stamps.

As published (Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012),
depth is registered to color; poses `tx ty tz qx qy qz qw` are of the optical axes in a world with z
up. A color image takes the depth nearest in time, and a pose interpolated between two or, of a
keyframe, that of its own time.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.common.readers import read_text
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.state import pose_between
from splatpilot.training.captures.capture import (
    OPTICAL_AXES,
    Capture,
    Lens,
    centered_pinhole,
    opencv_lens,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    FrameFiles,
    open_frames,
    pose_from_quaternion,
    read_rows,
)

MAX_GAP = 0.12  # [s] between two poses that one is interpolated from
_MAX_APART = 0.02  # [s] between a color image and its depth, as in the data set's own tools
_SAME_TIME = 0.005  # [s] between an image and the pose of its keyframe

# fx, fy, cx, cy [px], counted from the first pixel's center, and distortion k1 k2 p1 p2 k3, for
# images of 640x480 px, by the name of the folder or of the bag that its lists name. Published with
# the data sets: TUM's, and Bonn's dynamic scenes (Palazzolo et al. 2019).
_NAMES = r"(?:freiburg|(?<![a-z])fr)([123])(?![0-9])|rgbd_(bonn)_"
_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
    "bonn": (
        (542.822841, 542.57687, 315.59352, 237.756098),
        (0.039903, -0.099343, -7.3e-4, -1.44e-4),
    ),
}
_DEFAULT = (525.0, 525.0, 319.5, 239.5)
_UNITS = ((1e16, 1e-9), (1e13, 1e-6), (1e11, 1e-3))
"""Times since 1970 above which they are not in seconds, and the unit [s] that they are in."""
_CALIBRATION = "calibration.txt"  # of the images themselves, as in ETH3D's sequences


def recognizes(path: Path) -> bool:
    """Tells whether a folder looks like a TUM RGB-D sequence."""
    return (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists()


def read(path: Path, config: CaptureConfig) -> Capture:
    """Opens a TUM RGB-D sequence, without the color images that have no depth or pose in time."""

    def lens(width: int, height: int) -> Lens:
        file = path / _CALIBRATION
        if file.is_file():
            numbers = _read_calibration(file)
            own = opencv_lens(centered_pinhole(*numbers[:4]), width, height, numbers[4:].tolist())
            return replace(own, source=file.name)
        text = f"{path.resolve().name}\n{read_text(path / 'rgb.txt', 'replace')[:1000]}"
        if found := re.search(_NAMES, text):
            focal, distortion = _CAMERAS[found[1] or found[2]]
            own = opencv_lens(centered_pinhole(*focal), 640, 480, distortion)
            return replace(own, source=f"the name {found[0]}").scale_to(width, height)
        assumed = "the default of TUM's driver; set capture.intrinsics for another camera"
        return Lens(centered_pinhole(*_DEFAULT), 640, 480, source=assumed).scale_to(width, height)

    return open_sequence(path, "TUM RGB-D sequence", config, lens, 5000.0)


def _read_calibration(file: Path) -> NDArray[np.float64]:
    """Returns fx, fy, cx, cy [px] and the distortion that follows, (4,) to (9,)."""
    text = read_text(file)
    try:
        numbers = np.array(text.split(), dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    require(
        len(numbers) in (4, 8, 9) and np.isfinite(numbers).all(),
        f"{file}",
        "fx fy cx cy, and k1 k2 p1 p2 (k3) of a distorted camera",
        repr(text[:80]),
        "correct it, or set capture.intrinsics",
    )
    return numbers


def open_sequence(
    path: Path, source: str, config: CaptureConfig, lens: Callable[[int, int], Lens], unit: float
) -> Capture:
    """Opens lists and images in TUM's format, of any camera; see `open_frames`."""
    color_times, colors = _read_list(path / "rgb.txt")
    depth_times, depths = _read_list(path / "depth.txt")
    pose_file = path / "groundtruth.txt"
    rows = read_rows(pose_file, 8, "a pose t tx ty tz qx qy qz qw")
    rows = np.array([row for row in rows if np.isfinite(row).all()]).reshape(-1, 8)
    require(len(rows) >= 2, f"{pose_file}: finite poses", "at least 2", len(rows))
    rows[:, 0] = _seconds(rows[:, 0])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    for file, times in ((pose_file, rows[:, 0]), (path / "depth.txt", depth_times)):
        begin, end = color_times.min(), color_times.max()
        if end < times.min() - _MAX_APART or times.max() < begin - _MAX_APART:
            raise ValueError(
                f"{file}: runs from {times.min():.3f} to {times.max():.3f} s, but "
                f"{path / 'rgb.txt'} from {begin:.3f} to {end:.3f} s; write both by one clock"
            )

    def frame(color: str, depth: str, around: NDArray[np.float64], time: float) -> FrameFiles:
        def X_FC() -> RigidTransform:
            poses = [pose_from_quaternion(row[1:], f"{pose_file}, {row[0]} s") for row in around]
            if len(poses) == 1:
                return poses[0]
            s = (time - around[0, 0]) / (around[1, 0] - around[0, 0])
            return pose_between(poses[0], poses[1], s)

        return FrameFiles(path / color, X_FC, path / depth)

    frames = []
    for time, color in zip(color_times, colors, strict=True):
        nearest = int(np.argmin(np.abs(depth_times - time)))
        around = _poses_around(rows, time)
        if abs(depth_times[nearest] - time) <= _MAX_APART and len(around):
            frames.append(frame(color, depths[nearest], around, time))
    alone = len(colors) - len(frames)
    dropped = [
        f"{path / 'rgb.txt'}: {alone} of {len(colors)} color images have no depth within "
        f"{_MAX_APART} s, or neither two poses within {MAX_GAP} s around them nor one within "
        f"{_SAME_TIME} s"
    ]
    return open_frames(
        path,
        source,
        frames,
        axes=OPTICAL_AXES,
        config=config,
        lens=lens,
        depth_unit=unit,
        dropped=dropped if alone else (),
    )


def _poses_around(rows: NDArray[np.float64], time: float) -> NDArray[np.float64]:
    """Returns the rows that give the pose at `time`: two around it, one, or none."""
    after = int(np.searchsorted(rows[:, 0], time))
    if 0 < after < len(rows) and rows[after, 0] - rows[after - 1, 0] <= MAX_GAP:
        return rows[after - 1 : after + 1]
    nearest = int(np.argmin(np.abs(rows[:, 0] - time)))
    return rows[nearest : nearest + int(abs(rows[nearest, 0] - time) <= _SAME_TIME)]


def _read_list(file: Path) -> tuple[NDArray[np.float64], list[str]]:
    times, names = [], []
    for number, line in enumerate(read_text(file, "replace").splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            time, name = line.strip().split(maxsplit=1)
            times.append(float(time))
        except ValueError:
            raise ValueError(
                f"{file}, line {number} must be a time and a file name, got {line[:80]!r}"
            ) from None
        names.append(name)
    if not names:
        raise ValueError(f"{file}: lists no file")
    return _seconds(np.array(times)), names


def _seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns times [s] that may be in seconds, milli-, micro- or nanoseconds since 1970."""
    largest = np.abs(times).max(initial=0)
    return times * next((unit for least, unit in _UNITS if largest > least), 1.0)
