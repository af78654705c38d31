"""Captures registered by COLMAP: sparse models, photographs alone, and videos.

The world of a model is that of its registration; the configuration gives up direction and scale.
COLMAP's image coordinates, like ours, begin at the corner of the first pixel.
"""

import dataclasses
import shutil
import signal
import struct
import sys
import threading
from collections.abc import Iterable
from os.path import isfile
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import cv2  # Before pycolmap, whose libpng it would otherwise use.
import numpy as np
from numpy.typing import NDArray
from PIL import Image
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
    project_points,
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

if TYPE_CHECKING:
    import pycolmap

_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")
_IMAGE_FOLDERS = ("images", "../images", "../../images", "")
_MAX_PIXEL_DISTANCE = 20.0
"""[px] between a pixel and the registered point that it refers to."""
_MAX_COORDINATE = 1e12
"""Points beyond are damaged and left out."""
_WORDS = 32
_SAMPLE = 50_000
"""Descriptors that the words are found from."""
_MAX_SIZE = 1600
"""[px], longer side of the images in which features are extracted."""
_SMALL = 1200
"""[px], longer side below which photographs are enlarged for it."""
_MAX_EXHAUSTIVE = 60
"""Photographs up to which, by default, each is matched with all others."""
_PARTNERS = 20
"""Number of photographs that each of more is matched with."""
_SEED = 0
_EXIF_MODEL, _EXIF_IFD, _EXIF_FOCAL_LENGTH = 0x0110, 0x8769, 0x920A
_VIDEO_SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"}
_MIN_PHOTOGRAPHS = 3
_SHARPNESS_WIDTH = 480
"""[px], at which frames are compared."""
_QUALITY = 97


def import_pycolmap() -> ModuleType:
    """Imports pycolmap, which only captures that COLMAP registers need."""
    known = "pycolmap" in sys.modules
    pycolmap = import_extra("pycolmap", "photos")
    if not known and threading.current_thread() is threading.main_thread():
        # It makes SIGTERM print a stack, which can block forever on what it interrupted.
        if (handler := signal.getsignal(signal.SIGTERM)) is not None:
            signal.signal(signal.SIGTERM, handler)
    return pycolmap


def recognizes_model(path: Path) -> bool:
    """Tells whether a folder holds a COLMAP model."""
    return _model_folder(path) is not None


def _model_folder(path: Path) -> Path | None:
    for name in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((path / name / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
                return path / name
    return None


def read_model(path: Path, config: CaptureConfig) -> Capture:
    """Opens a COLMAP model with its images.

    Raises:
        ValueError, OSError: if a part is missing or damaged, too many frames cannot be used, or the
            scale cannot be determined as `config` says.
    """
    model = _model_folder(path)
    if model is None:
        raise FileNotFoundError(f"{path}: no COLMAP model (cameras, images, points3D) in it")
    reconstruction = _load_model(model)
    names = [image.name for image in reconstruction.images.values()]
    if not names:
        raise ValueError(f"{model}: the COLMAP model has no images")
    for folder in _IMAGE_FOLDERS:
        if any(isfile(path / folder / name) for name in names):
            return _open_model(path, "COLMAP model", reconstruction, path / folder, config)
    raise FileNotFoundError(
        f"{path}: none of the model's images, such as {names[0]:.200}, is in {path / 'images'} or "
        "here"
    )


def _load_model(model: Path) -> "pycolmap.Reconstruction":
    pycolmap = import_pycolmap()
    for file in sorted(model.glob("*.bin")):
        _check_counts(file, pycolmap)
    try:
        reconstruction = pycolmap.Reconstruction(model)
        for image in reconstruction.images.values():
            _ = image.name  # which may not be UTF-8
        return reconstruction
    except Exception as error:  # pycolmap raises what its C++ raises
        raise ValueError(f"{model}: not a readable COLMAP model ({reason_of(error)})") from None


def _check_counts(file: Path, pycolmap: ModuleType) -> None:
    """Checks the counts in a binary file of a model, which pycolmap allocates or loops over,
    against its size."""
    require_readable_size(file, 4 * file.stat().st_size)  # As objects it takes more.
    data = file.read_bytes()

    def number(form: str, at: int) -> int:
        return struct.unpack_from(f"<{form}", data, at)[0]

    def next_record(at: int) -> int:
        match file.stem:
            case "cameras":
                model = pycolmap.CameraModelId(number("i", at + 4))
                camera = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1)
                return at + 24 + 8 * len(camera.params)
            case "images":
                points = data.index(b"\0", at + 64) + 1
                return points + 8 + 24 * number("Q", points)
            case "points3D":
                return at + 51 + 8 * number("Q", at + 43)
            case "frames":
                return at + 68 + 16 * number("I", at + 64)
            case "rigs":
                sensors, at = number("I", at + 4), at + 8
                for i in range(sensors):
                    at += 8 if i == 0 else 9 + 56 * number("?", at + 8)
                return at
        return len(data)

    try:
        at = 8
        for _ in range(number("Q", 0)):
            at = next_record(at)
        if at != len(data):
            raise ValueError(f"{len(data)} bytes instead of {at}")
    except (ValueError, struct.error) as error:
        raise ValueError(f"{file} is damaged ({reason_of(error)}); copy it again") from None


def _open_model(
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
            raise ValueError(f"{path}, camera {number}: {reason_of(error)}") from None
    depths = path / config.scale.depth_folder if config.scale.depth_folder else None
    masks = _mask_folder(images)

    def frame(image: "pycolmap.Image") -> FrameFiles:
        camera_to_world = image.cam_from_world().inverse().matrix()
        stem = Path(image.name)
        return FrameFiles(
            images / image.name,
            lambda: pose_from_matrix(camera_to_world, f"{path}, image {image.name}"),
            _existing(depths / stem.with_suffix(s) for s in (".npy", ".png")) if depths else None,
            lenses[image.camera_id],
            # COLMAP lets the mask of a PNG have its name.
            _existing(masks / name for name in (f"{image.name}.png", image.name) if _is_png(name)),
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
        source,
        [frame(image) for image in sorted(registered, key=lambda image: image.name)],
        axes=OPTICAL_AXES,
        read_depth=lambda file: read_depth(file, config.depth_unit or 1000.0),
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


def _mask_folder(images: Path) -> Path:
    """Returns the folder `masks` of images: next to a folder `images`, or inside another."""
    return images.with_name("masks") if images.name == "images" else images / "masks"


def _existing(files: Iterable[Path]) -> Path | None:
    return next((file for file in files if isfile(file)), None)


def _is_png(name: str) -> bool:
    return name.lower().endswith(".png")


def _unmasked_points(
    capture: Capture, images: dict[str, "pycolmap.Image"], points: dict[int, "pycolmap.Point3D"]
) -> dict[int, "pycolmap.Point3D"]:
    """Returns the points that at least two images show in valid pixels."""
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
    K, source = camera.calibration_matrix(), "the COLMAP model"
    if config.intrinsics:
        K, source = pinhole(*config.intrinsics), "capture.intrinsics"
    if config.intrinsics or camera.is_undistorted():
        return Lens(K, camera.width, camera.height, source=source)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))

    return Lens(K, camera.width, camera.height, project, source=source)


def recognizes_photographs(path: Path) -> bool:
    """Tells whether images lie in a folder, or in its folder `images`."""
    return len(_photographs(path)) > 0


def _photographs(path: Path) -> list[Path]:
    for folder in (path, path / "images"):
        if folder.is_dir():
            files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
            if files:
                return sorted(files)
    return []


def read_photographs(path: Path, config: CaptureConfig) -> Capture:
    """Opens photographs without poses, which pycolmap registers: SIFT, matching, incremental
    mapping. The cache keeps the registration.

    Raises:
        ValueError, OSError: if fewer than half of the photographs, or fewer than three, can be
            registered, the scale cannot be determined as `config` says, or the cache cannot be
            written.
    """
    files, dropped = [], []
    for file in _photographs(path):
        try:
            image_size(file)
            files.append(file)
        except (ValueError, OSError) as error:
            dropped.append(str(error))
    total = len(files) + len(dropped)
    if len(files) < _MIN_PHOTOGRAPHS:
        raise ValueError(f"{path}: {len(files)} readable photographs, at least 3 are needed")
    folder = files[0].parent
    names = [file.name for file in files]
    masks = sorted(file for file in _mask_folder(folder).rglob("*") if file.is_file())
    version = import_pycolmap().__version__
    key = cache_key([*files, *masks], version, _MAX_SIZE, _SEED, config.partners)
    model = cache_folder(config, "photographs", key) / "model"
    if not model.is_dir():
        prepare_cache(model.parent)
        kept = "nothing is kept of the registration; the same command starts again"
        with folder_written_atomically(model) as written, resumable(lambda: kept):
            work = folder, names, one_camera(files), config.partners, written
            run_apart(f"{model}: registration", _register, work)
    reconstruction = _load_model(model)
    registered = {image.name for image in reconstruction.images.values() if image.has_pose}
    dropped += [
        f"{folder / name}: not registered, it shares too little with the other photographs"
        for name in names
        if name not in registered
    ]
    if len(registered) < max(_MIN_PHOTOGRAPHS, total / 2):
        raise ValueError(
            f"{path}: {len(registered)} of {total} photographs could be registered, at least 3 and "
            "half of them must; take more of them, each sharing most of its view with others"
        )
    return _open_model(path, "photographs", reconstruction, folder, config, dropped=tuple(dropped))


def one_camera(files: list[Path]) -> bool:
    """Tells whether size, camera model and focal length are the same in all photographs."""
    cameras = set()
    for file in files:
        with Image.open(file) as image:
            exif = image.getexif()
            focal_length = exif.get_ifd(_EXIF_IFD).get(_EXIF_FOCAL_LENGTH)
            cameras.add((image.size, exif.get(_EXIF_MODEL), focal_length))
    return len(cameras) == 1


def _register(work: tuple[Path, list[str], bool, int, Path]) -> None:
    """Writes the largest model of the images of a folder by name, of one camera or several, each
    matched with so many partners, into a folder.

    Seeds are fixed and images are numbered in order, so that threads do not change the result."""
    folder, names, one_camera, partners, written = work
    temporary = written / "work"
    temporary.mkdir()
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(_SEED)
    pycolmap.logging.minloglevel = 2
    database = temporary / "database.db"
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.AUTO
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, folder, mode, names)
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=_MAX_SIZE, use_gpu=False)
    # Enlarging the image first finds more in small ones and takes four times as long.
    small = max(max(image_size(folder / name)) for name in names) < _SMALL
    extraction.sift.first_octave = -1 if small else 0
    reader = pycolmap.ImageReaderOptions()
    if (masks := _mask_folder(folder)).is_dir():
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
            listed = temporary / "pairs.txt"
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
            temporary,
            options,
            initial_image_pair_callback=lambda: _advance(progress, 2),
            next_image_callback=lambda: _advance(progress, 1),
        )
    if not models:
        raise ValueError(
            f"{folder}: the {len(names)} photographs could not be registered; take them closer "
            "together, of a scene with texture, moving between them"
        )
    max(models.values(), key=lambda each: each.num_reg_images()).write(written)
    shutil.rmtree(temporary)


def _advance(progress: Progress, count: int) -> None:
    progress.update(count)


def _pairs(database: Path, names: list[str], partners: int) -> list[tuple[int, int]]:
    if partners == 0:
        partners = len(names) if len(names) <= _MAX_EXHAUSTIVE else _PARTNERS
    if partners >= len(names) - 1:
        return [(a, b) for a in range(len(names)) for b in range(a + 1, len(names))]
    opened = import_pycolmap().Database.open(database)
    try:
        return likely_pairs(similarity(opened, names), partners)
    finally:
        opened.close()


def likely_pairs(similarity: NDArray[np.float64], partners: int) -> list[tuple[int, int]]:
    """Returns pairs of each image with `partners` / 2 neighbors and the most similar others.

    Args:
        similarity: (N, N), of every two images.
        partners: about how many others an image is matched with.

    Returns:
        Pairs of indices, the smaller first, in order.
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
    """Returns the similarity (N, N), -1 to 1, of images whose features a database holds."""
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    features = []
    for name in names:
        descriptors = database.read_descriptors(numbers[name])  # which `data` does not keep alive
        features.append(np.sqrt(np.array(descriptors.data, dtype=np.float32)))  # RootSIFT
    return vlad_similarity(features)


def vlad_similarity(features: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Returns the cosines (N, N) between N images by their descriptors, each (., D).

    The difference of each descriptor from the nearest of 32 words is summed to one vector per image
    (VLAD; Jegou et al. 2010).
    """
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


def is_video(path: Path) -> bool:
    """Tells whether a path is a video, by its suffix."""
    return path.is_file() and path.suffix.lower() in _VIDEO_SUFFIXES


def read_video(path: Path, config: CaptureConfig) -> Capture:
    """Opens frames of a video as photographs, see `read_photographs`; the cache keeps them."""
    frames = cache_folder(config, "videos", cache_key([path], config.video_rate)) / "frames"
    if not frames.is_dir():
        prepare_cache(frames.parent)
        with folder_written_atomically(frames) as written:
            _extract_frames(path, config.video_rate, written)
    return read_photographs(frames, config)


def _extract_frames(path: Path, rate: float, folder: Path) -> None:
    """Writes the sharpest frame of each 1 / `rate` [s] as `00000.jpg` and so on."""
    video = cv2.VideoCapture(str(path))
    fps = video.get(cv2.CAP_PROP_FPS)
    if not video.isOpened() or not 0 < fps < 10_000:
        raise ValueError(f"{path}: not a readable video; convert it to H.264 in MP4")
    sharpest, current, index, count = -1.0, -1, 0, 0
    total = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0) or None
    with Progress(total=total, desc="video", unit="frame") as progress:
        while (decoded := video.read())[0]:
            frame, interval = decoded[1], int(index * rate / fps)
            sharpness = _sharpness(frame)
            if interval != current or sharpness > sharpest:
                count += interval != current
                current, sharpest = interval, sharpness
                file = folder / f"{interval:05d}.jpg"
                cv2.imwrite(str(file), frame, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            index += 1
            progress.update()
    video.release()
    if count < _MIN_PHOTOGRAPHS:
        raise ValueError(
            f"{path}: {index} frames in {index / fps:.1f} s give {count} of {rate:g} a second, at "
            f"least {_MIN_PHOTOGRAPHS} are needed; film longer, or increase capture.video_rate"
        )


def _sharpness(frame: NDArray) -> float:
    """Returns the variance of the Laplacian of a frame in small."""
    width = min(_SHARPNESS_WIDTH, frame.shape[1])
    size = width, max(1, frame.shape[0] * width // frame.shape[1])
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
