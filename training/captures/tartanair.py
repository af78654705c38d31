"""TartanAir V1 sequences: `image_left/`, `depth_left/` and `pose_left.txt` in one folder.

Layout and conventions as published with the data set (Wang et al., "TartanAir: A Dataset to Push
the Limits of Visual SLAM", IROS 2020): `%06d_left.png`, `%06d_left_depth.npy` (float32, metres,
along the optical axis), and one line `tx ty tz qx qy qz qw` a frame, the pose of a body (x forward,
y right, z down) whose camera looks along x, in a north-east-down world. The horizontal field of
view is 90 degrees.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from flysplat.training.captures.capture import Capture

# Optical axes (x right, y down, z forward) in the north-east-down body.
_R_BC = RotationMatrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
# Our world is z up: north, west, up, with the origin of the data set's world.
_X_WN = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))


def is_tartanair_v1(path: str | Path) -> bool:
    """Tells whether the folder looks like a TartanAir V1 sequence, whole or not."""
    path = Path(path)
    return (path / "pose_left.txt").exists() or (path / "image_left").is_dir()


def read_tartanair_v1(path: str | Path) -> Capture:
    """Opens a TartanAir V1 sequence; images and depths are loaded when asked for.

    Raises:
        FileNotFoundError: if the folder, one of its parts or the file of a frame is missing.
        ValueError: if the numbers of images, depths and poses differ, a file is empty, or a pose is
            no pose. The message names the file.
    """
    path = Path(path)
    image_folder, depth_folder, pose_file = (
        path / part for part in ("image_left", "depth_left", "pose_left.txt")
    )
    for part in (path, image_folder, depth_folder, pose_file):
        if not part.exists():
            raise FileNotFoundError(
                f"{part}: does not exist; a TartanAir V1 sequence is a folder with image_left/, "
                "depth_left/ and pose_left.txt"
            )
    images = _numbered(image_folder, r"(\d+)_left\.png")
    depths = _numbered(depth_folder, r"(\d+)_left_depth\.npy")
    X_WCs = _read_poses(pose_file)
    for number in sorted(images.keys() ^ depths.keys()):
        have, lack = (images, depth_folder) if number in images else (depths, image_folder)
        raise ValueError(
            f"{lack}: no file for frame {number:06d}, but there is {have[number]} "
            f"({len(images)} images, {len(depths)} depths); every frame needs both"
        )
    if len(images) != len(X_WCs):
        raise ValueError(
            f"{pose_file}: {len(X_WCs)} poses for {len(images)} images; one line a frame is needed"
        )
    for file in (*images.values(), *depths.values()):
        if file.stat().st_size == 0:
            raise ValueError(f"{file}: the file is empty; copy it again")

    image_files = [images[number] for number in sorted(images)]
    depth_files = [depths[number] for number in sorted(depths)]
    height, width = _read_image(image_files[0]).shape[:2]

    def load_image(i: int) -> NDArray[np.uint8]:
        return _sized(_read_image(image_files[i]), image_files[i], (height, width, 3))

    def load_depth(i: int) -> NDArray[np.float32]:
        return _sized(_read_depth(depth_files[i]), depth_files[i], (height, width))

    focal_length = width / 2
    return Capture(
        name=path.resolve().name,
        source=f"TartanAir V1 sequence {path.resolve()}",
        K=np.array([[focal_length, 0, width / 2], [0, focal_length, height / 2], [0, 0, 1.0]]),
        width=width,
        height=height,
        X_WCs=X_WCs,
        load_image=load_image,
        load_depth=load_depth,
        frame_names=[file.name for file in image_files],
    )


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Returns the files of `folder` by the number in their name."""
    files = {}
    for file in folder.iterdir():
        if match := re.fullmatch(pattern, file.name):
            files[int(match[1])] = file
    if not files:
        raise FileNotFoundError(f"{folder}: holds no file named like {pattern}")
    return files


def _read_poses(file: Path) -> list[RigidTransform]:
    """Returns the camera poses X_WC of a pose file."""
    X_WCs = []
    for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
        try:
            row = np.array(line.split(), dtype=np.float64)
        except ValueError:
            row = np.array([])
        if row.shape != (7,) or not np.isfinite(row).all():
            raise ValueError(
                f"{file}, line {number}: {line[:80]!r} is no pose; seven finite numbers "
                "tx ty tz qx qy qz qw are needed"
            )
        x, y, z, w = row[3:]
        norm = np.linalg.norm(row[3:])
        if abs(norm - 1) > 1e-3:
            raise ValueError(
                f"{file}, line {number}: the quaternion has the length {norm:.6g}, 1 within 0.001 "
                "is needed; the line should read tx ty tz qx qy qz qw"
            )
        R_NB = RotationMatrix(Quaternion(np.array([w, x, y, z]) / norm))
        X_WCs.append(_X_WN @ RigidTransform(R_NB @ _R_BC, row[:3]))
    return X_WCs


def _read_image(file: Path) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.fromfile(file, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{file}: not a readable image; copy it again")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)  # pyright: ignore[reportReturnType]


def _read_depth(file: Path) -> NDArray[np.float32]:
    """Reads depth; what is no number or not in front of the camera becomes 0, unknown."""
    try:
        depth = np.load(file, allow_pickle=False).astype(np.float32)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{file}: not a readable array ({error}); copy it again") from error
    depth[np.isnan(depth) | (depth < 0)] = 0
    return depth


def _sized(array: NDArray, file: Path, shape: tuple[int, ...]) -> NDArray:
    if array.shape != shape:
        raise ValueError(
            f"{file}: an array of shape {array.shape}, but the first image of the sequence "
            f"asks for {shape} (rows, columns, ...); all images and depths must have one size"
        )
    return array
