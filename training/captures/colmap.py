"""COLMAP models: images and a sparse model, read by pycolmap, undistorted, with their points.

The world of a model is that of its registration: where up is and how long a metre is comes from the
configuration. COLMAP's image coordinates count as ours, from the corner of the first pixel.
"""

import dataclasses
import shutil
import signal
import struct
import sys
import threading
from collections.abc import Callable
from os.path import isfile
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import cv2  # Before pycolmap, whose libpng it would otherwise take for its own.
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform
from scipy.cluster.vq import kmeans2, vq

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.processes import available_cores, run_apart
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.readers import reason_of, require_readable_size
from splatpilot.training.captures.capture import (
    OPTICAL_AXES,
    Capture,
    Lens,
    SfmPoints,
    all_valid,
    cache_folder,
    cache_key,
    pinhole,
    prepare_cache,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    IMAGE_SUFFIXES,
    FrameFiles,
    image_size,
    open_frames,
    pose_from_matrix,
    read_depth,
)
from splatpilot.training.captures.up_and_scale import make_metric, turn_upright

# Whether the binary files of a COLMAP model are as long as they claim.
#
# pycolmap believes what they say: a count that is wrong makes it take all memory, or loop for ever.


class _Records:
    """A file that is gone through from its beginning."""

    def __init__(self, file: Path) -> None:
        require_readable_size(file, 4 * file.stat().st_size)  # As objects it takes more.
        self._content = file.read_bytes()
        self._at = 0

    def take(self, form: str) -> tuple:
        """The next numbers, as `struct` describes them."""
        self.skip(size := struct.calcsize("<" + form))
        return struct.unpack_from("<" + form, self._content, self._at - size)

    def skip(self, size: int) -> None:
        if size > len(self._content) - self._at:
            raise ValueError(
                f"byte {self._at} claims {size} more bytes, there are "
                f"{len(self._content) - self._at}"
            )
        self._at += size

    def skip_text(self) -> None:
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise ValueError(f"the text from byte {self._at} does not end")
        self._at = end + 1

    def is_read(self) -> bool:
        return self._at == len(self._content)


def _camera(records: _Records, num_params: Callable[[int], int]) -> None:
    _, model, _, _ = records.take("iiQQ")
    records.skip(8 * num_params(model))


def _image(records: _Records, num_params: Callable[[int], int]) -> None:
    records.take("I7dI")  # number, pose, camera
    records.skip_text()
    records.skip(24 * records.take("Q")[0])


def _point(records: _Records, num_params: Callable[[int], int]) -> None:
    records.take("Q3d3Bd")  # number, place, colour, error
    records.skip(8 * records.take("Q")[0])


def _rig(records: _Records, num_params: Callable[[int], int]) -> None:
    _, sensors = records.take("II")
    if sensors:
        records.take("iI")
    for _ in range(sensors - 1):
        if records.take("iI?")[2]:
            records.skip(7 * 8)


def _frame(records: _Records, num_params: Callable[[int], int]) -> None:
    *_, data = records.take("II7dI")
    records.skip(16 * data)


_FILES = {"cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}


def check_records(model: Path, num_params: Callable[[int], int]) -> None:
    """Goes through the binary files of a model.

    Args:
        model: its folder.
        num_params: how many numbers describe a camera of the model with this number.

    Raises:
        ValueError: if one is cut short, longer than it claims or too large; the message names it.
    """
    for name, skip in _FILES.items():
        file = model / f"{name}.bin"
        if not file.is_file():
            continue
        records = _Records(file)
        try:
            (count,) = records.take("Q")
            for _ in range(count):
                skip(records, num_params)
            if not records.is_read():
                raise ValueError("more follows the last record")
        except ValueError as error:
            raise ValueError(f"{file} is damaged: {error}; copy it again") from None


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


# Which photographs are compared: of many, those that are neighbours or look alike.
#
# Alike is what local features say: their descriptors, each by its difference from the nearest of
# `_WORDS` typical ones, are summed up to one vector an image (VLAD; Jegou et al. 2010), and vectors
# are compared by the cosine between them.


if TYPE_CHECKING:
    import pycolmap

_WORDS = 32
_SAMPLE = 50_000
"""Descriptors that the typical ones are found from."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every two of `count` images, by number."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def likely_pairs(similarity: NDArray[np.float64], partners: int) -> list[tuple[int, int]]:
    """Each image with half of `partners` neighbours in its order and as many others most alike.

    Args:
        similarity: (N, N), of every two images.
        partners: about how many others an image is compared with.

    Returns:
        Pairs of numbers, the smaller first, in order.
    """
    count, near = len(similarity), max(1, partners // 4)  # on either side
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + near + 1, count))}
    others = similarity.copy()
    np.fill_diagonal(others, -np.inf)
    for a, b in pairs:
        others[a, b] = others[b, a] = -np.inf
    for a, row in enumerate(others):
        for b in np.argsort(-row, kind="stable")[: partners - 2 * near]:
            if np.isfinite(row[b]):
                pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pairs)


def similarity(database: "pycolmap.Database", names: list[str]) -> NDArray[np.float64]:
    """How alike images are that a database of features holds, (N, N) from -1 to 1."""
    number_of = {image.name: image.image_id for image in database.read_all_images()}
    return vlad_similarity([_descriptors(database, number_of[name]) for name in names])


def _descriptors(database: "pycolmap.Database", number: int) -> NDArray[np.float32]:
    """RootSIFT (n, 128) of an image."""
    held = database.read_descriptors(number)  # its `data` is a view, which does not keep it
    return np.sqrt(np.array(held.data, dtype=np.float32))


def vlad_similarity(features: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """The cosines (N, N) between N images, each of any number of descriptors (., D)."""
    rng = np.random.default_rng(0)
    pool = np.concatenate(features)
    sample = pool[rng.permutation(len(pool))[:_SAMPLE]]
    words = min(_WORDS, len(sample))
    centers, _ = kmeans2(sample, words, iter=10, minit="points", rng=0)
    vectors = np.zeros((len(features), words, pool.shape[1]))
    for vector, descriptors in zip(vectors, features, strict=True):
        if len(descriptors):
            nearest, _ = vq(descriptors, centers)
            np.add.at(vector, nearest, descriptors - centers[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-12  # no word outweighs others
    flat = vectors.reshape(len(features), -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True) + 1e-12
    return flat @ flat.T


# Photographs alone, registered with pycolmap: SIFT, matching, incremental mapping.
#
# The registration is kept in a cache under a name made from the photographs, so that it happens
# once.


_MAX_SIZE = 1600
"""[px], longer side of the images in which features are sought."""
_SMALL = 1200
"""[px], longer side below which photographs are enlarged for it."""
_ALL_OF = 60
"""Photographs of which, if not told otherwise, each is compared with all others."""
_PARTNERS = 20
"""With how many each of more is compared."""
_SEED = 0
_EXIF_MODEL, _EXIF_IFD, _EXIF_FOCAL_LENGTH = 0x0110, 0x8769, 0x920A


def photographs_in(path: Path) -> list[Path]:
    """Returns the images that lie in a folder, or in its folder `images`, by name."""
    for folder in (path, path / "images"):
        if folder.is_dir():
            files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
            if files:
                return sorted(files)
    return []


def read_photographs(path: Path, config: CaptureConfig) -> Capture:
    """Opens photographs without poses, which are registered first unless that has been done.

    Photographs that cannot be read or registered are left out.

    Raises:
        ValueError: if fewer than half of the photographs, or fewer than three, can be registered,
            or the scale cannot be had as `config` asks.
        OSError: if the cache cannot be written.
    """
    files, dropped = [], []
    for file in photographs_in(path):
        try:
            image_size(file)
            files.append(file)
        except (ValueError, OSError) as error:
            dropped.append(str(error))
    total = len(files) + len(dropped)
    if len(files) < 3:
        raise ValueError(f"{path}: {len(files)} readable photographs, at least 3 are needed")
    folder = files[0].parent
    names = [file.name for file in files]
    masks = sorted(file for file in mask_folder(folder).rglob("*") if file.is_file())
    version = import_pycolmap().__version__
    key = cache_key([*files, *masks], version, _MAX_SIZE, _SEED, config.partners)
    model = cache_folder(config, "photographs", key) / "model"
    if not model.is_dir():
        _register(folder, names, one_camera(files), config.partners, model)
    reconstruction = read_model(model)
    registered = {image.name for image in reconstruction.images.values() if image.has_pose}
    dropped += [
        f"{folder / name}: not registered, it shares too little with the other photographs"
        for name in names
        if name not in registered
    ]
    if len(registered) < max(3, total / 2):
        raise ValueError(
            f"{path}: {len(registered)} of {total} photographs could be registered, at least 3 and "
            "half of them are needed; take more of them, each sharing most of its view with others"
        )
    return capture_of_model(
        path, "photographs", reconstruction, folder, config, dropped=tuple(dropped)
    )


def one_camera(files: list[Path]) -> bool:
    """Tells whether size, camera model and focal length are the same in all photographs."""
    kinds = set()
    for file in files:
        with Image.open(file) as image:
            exif = image.getexif()
            focal_length = exif.get_ifd(_EXIF_IFD).get(_EXIF_FOCAL_LENGTH)
            kinds.add((image.size, exif.get(_EXIF_MODEL), focal_length))
    return len(kinds) == 1


def _register(folder: Path, names: list[str], one_camera: bool, partners: int, model: Path) -> None:
    """Registers photographs and writes the largest model that results, whole or not at all."""
    prepare_cache(model.parent)
    with folder_written_atomically(model) as written:
        work = folder, names, one_camera, partners, written
        with resumable(
            lambda: "nothing is kept of the registration; the same command starts again"
        ):
            run_apart(f"{model}: registration", _write_model, work)


def _write_model(work: tuple[Path, list[str], bool, int, Path]) -> None:
    """Writes the model of the images of a folder by name, of one camera or several, each compared
    with so many partners, into a folder.

    Seeds are fixed and images get their numbers in order, so that the result does not depend on
    which thread is first."""
    folder, names, one_camera, partners, written = work
    kept = written / "work"
    kept.mkdir()
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(_SEED)
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 2
    try:
        database = kept / "database.db"
        mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.AUTO
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, folder, mode, names)
        extraction = pycolmap.FeatureExtractionOptions(max_image_size=_MAX_SIZE, use_gpu=False)
        # Enlarging the image first finds more in small ones and takes four times as long.
        small = max(max(image_size(folder / name)) for name in names) < _SMALL
        extraction.sift.first_octave = -1 if small else 0
        reader = pycolmap.ImageReaderOptions()
        if (masks := mask_folder(folder)).is_dir():
            reader.mask_path = masks
        threads = available_cores()
        with Progress(total=len(names), desc="extracting features", unit="photo") as progress:
            for start in range(0, len(names), threads):
                some = names[start : start + threads]
                pycolmap.extract_features(
                    database, folder, some, reader_options=reader, extraction_options=extraction
                )
                progress.update(len(some))
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = _SEED
        pairs = _pairs(database, names, partners)
        block = max(1, len(pairs) // 20)
        with Progress(total=len(pairs), desc="matching pairs", unit="pair") as progress:
            for start in range(0, len(pairs), block):
                some = pairs[start : start + block]
                listed = kept / "pairs.txt"
                listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in some))
                pycolmap.match_image_pairs(
                    database,
                    matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False),
                    pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
                    verification_options=verification,
                )
                progress.update(len(some))
        options = pycolmap.IncrementalPipelineOptions(random_seed=_SEED, num_threads=1)
        options.mapper.random_seed = options.triangulation.random_seed = _SEED
        options.mapper.num_threads = 1
        options.min_model_size = min(options.min_model_size, len(names))
        with Progress(total=len(names), desc="registering photographs", unit="photo") as progress:
            models = pycolmap.incremental_mapping(
                database,
                folder,
                kept,
                options,
                initial_image_pair_callback=lambda: _advance(progress, 2),
                next_image_callback=lambda: _advance(progress, 1),
            )
        if not models:
            raise ValueError(
                f"{folder}: the {len(names)} photographs could not be registered; take them closer "
                "together, of a place with texture, moving between them"
            )
        largest = max(models.values(), key=lambda each: each.num_reg_images())
        largest.write(written)
        shutil.rmtree(kept)
    finally:
        pycolmap.logging.minloglevel = level


def _pairs(database: Path, names: list[str], partners: int) -> list[tuple[int, int]]:
    if partners == 0:
        partners = len(names) if len(names) <= _ALL_OF else _PARTNERS
    if partners >= len(names) - 1:
        return all_pairs(len(names))
    opened = import_pycolmap().Database.open(database)
    try:
        return likely_pairs(similarity(opened, names), partners)
    finally:
        opened.close()


def _advance(progress: Progress, count: int) -> None:
    progress.update(count)


_SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"}
_FEWEST = 3
_SHARPNESS_WIDTH = 480
"""[px], at which frames are compared."""
_QUALITY = 97


def is_video(path: Path) -> bool:
    """Tells whether a path is a video, by its suffix."""
    return path.is_file() and path.suffix.lower() in _SUFFIXES


def read_video(path: Path, config: CaptureConfig) -> Capture:
    """Opens a video as photographs, see `read_photographs`. Its frames are kept in the cache.

    Raises:
        ValueError: if it cannot be read or is too short, and see `read_photographs`.
        OSError: if the cache cannot be written.
    """
    frames = cache_folder(config, "videos", cache_key([path], config.video_rate)) / "frames"
    if not frames.is_dir():
        prepare_cache(frames.parent)
        with folder_written_atomically(frames) as written:
            _extract(path, config.video_rate, written)
    return read_photographs(frames, config)


def _extract(path: Path, rate: float, folder: Path) -> None:
    """Writes the sharpest frame of each 1 / `rate` [s] as `00000.jpg` and so on."""
    video = cv2.VideoCapture(str(path))
    try:
        fps = video.get(cv2.CAP_PROP_FPS)
        if not video.isOpened() or not 0 < fps < 10_000:
            raise ValueError(f"{path}: not a readable video; convert it to H.264 in MP4")
        best: NDArray | None = None
        sharpest, interval, index = -1.0, 0, 0
        total = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0) or None
        with Progress(total=total, desc="video", unit="frame") as progress:
            while True:
                there, frame = video.read()
                if best is not None and (not there or int(index * rate / fps) > interval):
                    file = folder / f"{interval:05d}.jpg"
                    cv2.imwrite(str(file), best, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
                    best, sharpest = None, -1.0
                if not there:
                    break
                interval = int(index * rate / fps)
                if (sharpness := _sharpness(frame)) > sharpest:
                    best, sharpest = frame, sharpness
                index += 1
                progress.update()
    finally:
        video.release()
    if (count := len(list(folder.iterdir()))) < _FEWEST:
        raise ValueError(
            f"{path}: {index} frames in {index / fps:.1f} s give {count} of {rate:g} a second, at "
            f"least {_FEWEST} are needed; film longer, or set capture.video_rate to more"
        )


def _sharpness(frame: NDArray) -> float:
    """The variance of the Laplacian of a frame in small."""
    width = min(_SHARPNESS_WIDTH, frame.shape[1])
    size = width, max(1, frame.shape[0] * width // frame.shape[1])
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
