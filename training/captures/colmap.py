"""COLMAP's sparse models with their images.

The world of a model is that of its registration; the configuration gives up direction and scale.
COLMAP's image coordinates, like ours, begin at the corner of the first pixel.
"""

import dataclasses
import signal
import struct
import sys
import threading
from os.path import isfile
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING

import cv2  # noqa: F401  Before pycolmap, whose libpng it would otherwise use.
import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.readers import error_summary, readable, require_readable_size
from splatpilot.training.captures.capture import (
    OPTICAL_AXES,
    Capture,
    Lens,
    SfmPoints,
    all_valid,
    pinhole,
    project_points,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    FrameFiles,
    first_file,
    open_frames,
    pose_from_matrix,
    read_depth,
)
from splatpilot.training.captures.up_and_scale import make_metric, turn_upright

if TYPE_CHECKING:
    import pycolmap

_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")
_IMAGE_FOLDERS = ("images", "../images", "../../images", "")
_MIN_RECORD = {"cameras": 48, "images": 73, "points3D": 51, "rigs": 8, "frames": 68}
"""[bytes] of one entry of the binary files of a model."""
_MAX_PIXEL_DISTANCE = 20.0  # [px] between a pixel and the registered point that it refers to
_MAX_COORDINATE = 1e12  # points beyond are damaged and left out


def import_pycolmap() -> ModuleType:
    """Imports pycolmap, which only captures that COLMAP registers need."""
    known = "pycolmap" in sys.modules
    pycolmap = import_extra("pycolmap", "photos")
    if not known and threading.current_thread() is threading.main_thread():
        # It makes SIGTERM print a stack, which can block forever on what it interrupted.
        if (handler := signal.getsignal(signal.SIGTERM)) is not None:
            signal.signal(signal.SIGTERM, handler)
    return pycolmap


def model_folder(path: Path) -> Path | None:
    """Returns the folder of the COLMAP model in a capture, the largest of several, if any."""
    for name in _MODEL_FOLDERS:
        folders = [path / name]
        if folders[0].name == "0" and folders[0].parent.is_dir():  # parts of a scene fell apart
            folders = sorted(each for each in folders[0].parent.iterdir() if each.name.isdigit())
        if found := list(filter(None, map(_images_file, folders))):
            return max(found, key=lambda file: file.stat().st_size).parent
    return None


def _images_file(folder: Path) -> Path | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
            return folder / f"images{suffix}"
    return None


def read_model(path: Path, config: CaptureConfig) -> Capture:
    """Opens a COLMAP model with its images."""
    model = model_folder(path)
    if model is None:
        raise FileNotFoundError(f"{path}: no COLMAP model (cameras, images, points3D) in it")
    reconstruction = load_model(model)
    names = [image.name for image in reconstruction.images.values()]
    if not names:
        raise ValueError(f"{model}: the COLMAP model has no images")
    for folder in _IMAGE_FOLDERS:
        if any(isfile(path / folder / name) for name in names):
            return open_model(path, "COLMAP model", reconstruction, path / folder, config)
    raise FileNotFoundError(
        f"{path}: none of the model's images, such as {names[0]:.200}, is in {path / 'images'} or "
        "here"
    )


def load_model(model: Path) -> "pycolmap.Reconstruction":
    """Returns the model in a folder."""
    pycolmap = import_pycolmap()
    files = sorted(model.glob("*.bin"))
    with readable(model, "COLMAP model"), TemporaryDirectory(prefix="splatpilot-") as copy:
        for file in files:
            size = file.stat().st_size
            require_readable_size(file, 4 * size)  # As objects it takes more.
            with file.open("rb") as stream:
                (count,) = struct.unpack("<Q", stream.read(8))
            # pycolmap allocates, or loops over, any number of entries.
            if count * _MIN_RECORD.get(file.stem, 0) > size:
                raise ValueError(f"{file.name}: {count} entries in {size} bytes")
        reconstruction = pycolmap.Reconstruction(model)
        for image in reconstruction.images.values():
            _ = image.name  # which may not be UTF-8
        reconstruction.write_binary(copy)
        for file in files:  # pycolmap does not check their end.
            complete = Path(copy, file.name)
            if complete.is_file() and file.stat().st_size != (size := complete.stat().st_size):
                raise ValueError(f"{file.name} must have {size} bytes, got {file.stat().st_size}")
    return reconstruction


def open_model(
    path: Path,
    source: str,
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
            raise ValueError(f"{path}, camera {number}: {error_summary(error)}") from None
    depths = path / config.scale.depth_folder if config.scale.depth_folder else None
    masks = mask_folder(images)

    def frame(image: "pycolmap.Image") -> FrameFiles:
        camera_to_world = image.cam_from_world().inverse().matrix()
        stem, mask_names = Path(image.name), (f"{image.name}.png", image.name)
        return FrameFiles(
            images / image.name,
            lambda: pose_from_matrix(camera_to_world, f"{path}, image {image.name}"),
            first_file(*(depths / stem.with_suffix(s) for s in (".npy", ".png") if depths)),
            lenses[image.camera_id],
            # COLMAP lets the mask of a PNG have its name.
            first_file(*(masks / name for name in mask_names if name.lower().endswith(".png"))),
            name=image.name,
        )

    def read(file: Path, unit: float) -> NDArray[np.float32]:
        return read_depth(file, 1.0 if file.suffix == ".npy" and not config.depth_unit else unit)

    registered = [image for image in reconstruction.images.values() if image.has_pose]
    total = max(len(reconstruction.images), len(registered) + len(dropped))
    note = f"{len(registered)} of {total} images are registered"
    if reconstruction.points3D:
        error = reconstruction.compute_mean_reprojection_error()
        note += f", with a mean reprojection error of {error:.2f} px"
    capture = open_frames(
        path,
        source,
        [frame(image) for image in sorted(registered, key=lambda image: image.name)],
        axes=OPTICAL_AXES,
        config=config,
        read_depth=read,
        up="",
        dropped=dropped,
        notes=[note],
    )
    by_name = {image.name: image for image in registered}

    def locate(name: str, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = [point for point in by_name[name].points2D if point.has_point3D()]
        distance = [float(np.linalg.norm(point.xy - pixel)) for point in seen]
        if min(distance, default=np.inf) > _MAX_PIXEL_DISTANCE:
            raise ValueError(
                f"scale.between: no registered point within {_MAX_PIXEL_DISTANCE:g} px of {name}@"
                f"{pixel[0]:g},{pixel[1]:g} (the nearest: {min(distance, default=np.inf):.0f} px); "
                "choose a more distinct point"
            )
        return reconstruction.points3D[seen[int(np.argmin(distance))].point3D_id].xyz

    points = {
        number: point
        for number, point in reconstruction.points3D.items()
        if (np.abs(point.xyz) < _MAX_COORDINATE).all()
    }
    if capture.load_valid is not all_valid:
        points = _unmasked_points(capture, by_name, points)
    if points:
        p_WQ = np.array([point.xyz for point in points.values()])
        colors = np.array([point.color for point in points.values()]) / 255
        capture = dataclasses.replace(capture, points=SfmPoints(p_WQ, colors))
    return turn_upright(make_metric(capture, config.scale, locate), config.up or "cameras")


def mask_folder(images: Path) -> Path:
    """Returns the folder `masks` of images: next to a folder `images`, or inside another."""
    return images.with_name("masks") if images.name == "images" else images / "masks"


def _unmasked_points(
    capture: Capture, images: dict[str, "pycolmap.Image"], points: dict[int, "pycolmap.Point3D"]
) -> dict[int, "pycolmap.Point3D"]:
    times = dict.fromkeys(points, 0)
    for i, name in enumerate(capture.frame_names):
        seen = [point.point3D_id for point in images[name].points2D if point.point3D_id in points]
        if not seen:
            continue
        p_WQ = np.array([points[number].xyz for number in seen])
        p_CQ = capture.X_WCs[i].inverse().multiply(p_WQ.T).T
        inside, rows, columns = project_points(capture.K, p_CQ, capture.width, capture.height)
        shown = np.flatnonzero(inside)[capture.load_valid(i)[rows, columns]]
        for k in shown.tolist():
            times[seen[k]] += 1
    return {number: point for number, point in points.items() if times[number] > 1}


def _lens(camera: "pycolmap.Camera", config: CaptureConfig) -> Lens:
    found = camera.calibration_matrix()
    K, source = found, "the COLMAP model"
    if config.intrinsics:  # which replace those of the model; its distortion stays
        K, source = pinhole(*config.intrinsics), "capture.intrinsics"
    if camera.is_undistorted():
        return Lens(K, camera.width, camera.height, source=source)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        pixels = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
        return (pixels - found[:2, 2]) / np.diag(found)[:2] * np.diag(K)[:2] + K[:2, 2]

    return Lens(K, camera.width, camera.height, project, source=source)
