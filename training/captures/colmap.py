"""COLMAP models: images and a sparse model, read by pycolmap, undistorted, with their points.

The world of a model is that of its registration: where up is and how long a metre is comes from the
configuration. COLMAP's image coordinates count as ours, from the corner of the first pixel.
"""

import dataclasses
import signal
import sys
import threading
from os.path import isfile  # false, too, of names that no file system takes
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import cv2  # noqa: F401  # Before pycolmap, whose libpng it would otherwise take for its own.
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.extras import import_extra
from splatpilot.training.captures.capture import OPTICAL_AXES, Capture, SfmPoints, all_valid
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.colmap_records import check_records
from splatpilot.training.captures.frame_files import FrameFiles, open_frames
from splatpilot.training.captures.image_files import read_depth
from splatpilot.training.captures.lens import Lens, pinhole
from splatpilot.training.captures.metric_scale import make_metric
from splatpilot.training.captures.poses import pose_from_matrix
from splatpilot.training.captures.upright import turn_upright

if TYPE_CHECKING:
    import pycolmap

_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")
_IMAGE_FOLDERS = ("images", "../images", "../../images", "")
_NEAREST = 20.0
"""[px], how far a point that is meant by a pixel may be from it."""
_LARGEST_COORDINATE = 1e12
"""Coordinates of points, beyond which they are a mistake of the file and left out."""


def model_folder(path: Path) -> Path | None:
    """Returns the folder in a capture that holds a COLMAP model, None if none does."""
    for name in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((path / name / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
                return path / name
    return None


def mask_folder(images: Path) -> Path:
    """Returns the folder `masks` of images: beside a folder `images`, or inside another."""
    return images.with_name("masks") if images.name == "images" else images / "masks"


def import_pycolmap() -> ModuleType:
    """Imports pycolmap, which only captures that COLMAP registers need.

    Raises:
        ModuleNotFoundError: if it is not installed; the message says what to install.
    """
    known = "pycolmap" in sys.modules
    pycolmap = import_extra("pycolmap", "photos")
    if not known and threading.current_thread() is threading.main_thread():
        # It has SIGTERM print a stack, which can wait for ever for what it interrupted.
        if (handler := signal.getsignal(signal.SIGTERM)) is not None:
            signal.signal(signal.SIGTERM, handler)
    return pycolmap


def read_colmap(path: Path, config: CaptureConfig) -> Capture:
    """Opens a COLMAP model with its images.

    Raises:
        FileNotFoundError: if there is no model or no folder of images.
        ValueError: if the model cannot be read, too many frames cannot be used, or the scale cannot
            be had as `config` asks.
    """
    model = model_folder(path)
    if model is None:
        raise FileNotFoundError(f"{path}: no COLMAP model (cameras, images, points3D) in it")
    reconstruction = read_model(model)
    names = [image.name for image in reconstruction.images.values()]
    if not names:
        raise ValueError(f"{model}: the COLMAP model has no images")
    for folder in _IMAGE_FOLDERS:
        if any(isfile(path / folder / name) for name in names):
            return capture_of_model(path, "COLMAP model", reconstruction, path / folder, config)
    raise FileNotFoundError(
        f"{path}: none of the model's images, such as {names[0]}, is in {path / 'images'} or here"
    )


def read_model(model: Path) -> "pycolmap.Reconstruction":
    """Reads the files of a model.

    Raises:
        ValueError: if they are damaged or do not belong together; the message names the folder.
    """
    pycolmap = import_pycolmap()

    def num_params(number: int) -> int:
        kind = pycolmap.CameraModelId(number)
        return len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)

    check_records(model, num_params)
    try:
        reconstruction = pycolmap.Reconstruction(model)
        for image in reconstruction.images.values():
            _ = image.name  # which may be no UTF-8
        return reconstruction
    except Exception as error:  # pycolmap raises what its C++ raises
        raise ValueError(f"{model}: not a readable COLMAP model ({reason_of(error)})") from None


def capture_of_model(
    path: Path,
    kind: str,
    reconstruction: "pycolmap.Reconstruction",
    images: Path,
    config: CaptureConfig,
    dropped: tuple[str, ...] = (),
) -> Capture:
    """Returns the capture of a registered model, upright and, if `config` says how, metric."""
    lenses = {}
    for number, camera in reconstruction.cameras.items():
        try:
            lenses[number] = _lens(camera, config)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{path}, camera {number}: {reason_of(error)}") from None
    depths = path / config.scale.depth_folder if config.scale.depth_folder else None
    masks = mask_folder(images)

    def frame(image: "pycolmap.Image") -> FrameFiles:
        world_to_camera = image.cam_from_world().inverse().matrix()

        def X_FC() -> RigidTransform:
            return pose_from_matrix(world_to_camera, f"{path}, image {image.name}")

        return FrameFiles(
            images / image.name,
            X_FC,
            _depth_file(depths, image.name) if depths is not None else None,
            lenses[image.camera_id],
            _mask_file(masks, image.name),
            name=image.name,
        )

    registered = [image for image in reconstruction.images.values() if image.has_pose]
    total = max(len(reconstruction.images), len(registered) + len(dropped))
    note = f"{len(registered)} of {total} images are registered"
    if reconstruction.points3D:
        error = reconstruction.compute_mean_reprojection_error()
        note += f", with a mean reprojection error of {error:.2f} px"
    capture = open_frames(
        path,
        kind,
        [frame(image) for image in sorted(registered, key=lambda image: image.name)],
        axes=OPTICAL_AXES,
        read_depth=lambda file: read_depth(file, config.depth_unit or 1000.0),
        dropped=dropped,
        notes=[note],
    )
    by_name = {image.name: image for image in registered}

    def locate(name: str, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        image = by_name[name]
        seen = [point for point in image.points2D if point.has_point3D()]
        distance = [float(np.linalg.norm(point.xy - pixel)) for point in seen]
        if not seen or min(distance) > _NEAREST:
            nearest = f"the nearest is {min(distance):.0f} px away" if seen else "there is none"
            raise ValueError(
                f"scale.between: no registered point within {_NEAREST:g} px of {name}@"
                f"{pixel[0]:g},{pixel[1]:g} ({nearest}); choose a more distinct place"
            )
        return reconstruction.points3D[seen[int(np.argmin(distance))].point3D_id].xyz

    points = {
        number: point
        for number, point in reconstruction.points3D.items()
        if (np.abs(point.xyz) < _LARGEST_COORDINATE).all()
    }
    if capture.load_valid is not all_valid:
        points = _shown_points(capture, by_name, points)
    if points:
        capture = dataclasses.replace(
            capture,
            points=SfmPoints(
                np.array([point.xyz for point in points.values()]),
                np.array([point.color for point in points.values()]) / 255,
            ),
        )
    return turn_upright(make_metric(capture, config.scale, locate), config.up or "cameras")


def _shown_points(
    capture: Capture, images: dict[str, "pycolmap.Image"], points: dict[int, "pycolmap.Point3D"]
) -> dict[int, "pycolmap.Point3D"]:
    """Returns the points that at least two images show in valid pixels."""
    times = dict.fromkeys(points, 0)
    for i, name in enumerate(capture.frame_names):
        seen = [point.point3D_id for point in images[name].points2D if point.point3D_id in points]
        if not seen:
            continue
        p_WQ = np.array([points[number].xyz for number in seen])
        x, y, z = capture.K @ capture.X_WCs[i].inverse().multiply(p_WQ.T)
        column = (x / z).clip(0, capture.width - 1).astype(int)
        row = (y / z).clip(0, capture.height - 1).astype(int)
        for number, valid in zip(seen, capture.load_valid(i)[row, column], strict=True):
            times[number] += int(valid)
    return {number: point for number, point in points.items() if times[number] > 1}


def _lens(camera: "pycolmap.Camera", config: CaptureConfig) -> Lens:
    K, source = camera.calibration_matrix(), "the COLMAP model"
    if config.intrinsics:
        K, source = pinhole(*config.intrinsics), "capture.intrinsics"
    if config.intrinsics or camera.is_undistorted():
        return Lens(K, camera.width, camera.height, source=source)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))

    return Lens(K, camera.width, camera.height, project, source=source)


def _depth_file(folder: Path, name: str) -> Path | None:
    files = (folder / Path(name).with_suffix(suffix) for suffix in (".npy", ".png"))
    return next((file for file in files if isfile(file)), None)


def _mask_file(folder: Path, name: str) -> Path | None:
    """Returns the mask of an image, which COLMAP lets have the name of a PNG itself."""
    names = (f"{name}.png", name) if name.lower().endswith(".png") else (f"{name}.png",)
    return next((folder / each for each in names if isfile(folder / each)), None)
