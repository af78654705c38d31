"""Photographs alone and videos, which pycolmap registers: SIFT, matching, incremental mapping."""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import batched, combinations
from pathlib import Path
from typing import TYPE_CHECKING

import cv2  # Before pycolmap, whose libpng it would otherwise use.
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from scipy.cluster.vq import kmeans2, vq

from splatpilot.systems.common.processes import available_cores, run_in_subprocess
from splatpilot.systems.common.progress import Progress, resumable, say
from splatpilot.systems.common.validation import require
from splatpilot.training.captures.capture import Capture, SfmPoints
from splatpilot.training.captures.capture_config import (
    CaptureConfig,
    cache_folder,
    cache_key,
    cached_folder,
)
from splatpilot.training.captures.colmap import (
    import_pycolmap,
    load_model,
    mask_folder,
    open_model,
)
from splatpilot.training.captures.frames import IMAGE_SUFFIXES, image_header

if TYPE_CHECKING:
    import pycolmap

_WORDS = 32
_SAMPLE = 50_000  # descriptors that the words are found from
_MAX_SIZE = 1600  # [px], longer side of the images in which features are extracted
_SMALL = 1200  # [px], longer side below which photographs are enlarged for it
_MAX_EXHAUSTIVE = 60  # photographs up to which, by default, each is matched with all others
_PARTNERS = 20  # number of photographs that each of more is matched with
_SEED = 0
_VIDEO_SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"}
_UNREADABLE = {".heic", ".heif", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw"}
_POSES = ("poses_bounds.npy", "cameras.xml")  # of LLFF, of Metashape
_MIN_PHOTOGRAPHS = 3
_SHARPNESS_WIDTH = 480  # [px], at which frames are compared
_QUALITY = 97
_OVERLAP, _FEATURES = 10, 2048  # of images to be matched, and maximum of an image
_MIN_POINTS = 100  # that are triangulated


def image_files(path: Path) -> list[Path]:
    """Returns the images in a folder, or in its folder `images`; none of an unbundled SOG."""
    for folder in (path, path / "images"):
        if folder.is_dir() and not (folder / "means_l.webp").exists():
            suffixes = IMAGE_SUFFIXES | _UNREADABLE
            files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes]
            if files:
                return sorted(files)
    return []


def read_photographs(path: Path, config: CaptureConfig) -> Capture:
    """Opens photographs without poses, registered by pycolmap; the cache keeps the registration. At
    least three, and half of them, must be registered. Registration keeps `config.intrinsics`."""
    files, dropped = [], []
    poses = [name for name in _POSES if (path / name).exists()]
    if poses and config.kind != "photographs":
        raise ValueError(
            f"{path}: its poses in {poses[0]} are not read; convert them to COLMAP or "
            "nerfstudio, or set capture.kind=photographs to register the images again"
        )
    found = image_files(path)
    if unreadable := [file for file in found if file.suffix.lower() in _UNREADABLE]:
        kinds = ", ".join(sorted({file.suffix[1:].upper() for file in unreadable}))
        dropped.append(
            f"{path}: {len(unreadable)} {kinds} images cannot be read; convert them to JPEG"
        )
    for file in (each for each in found if each not in unreadable):
        try:
            is_depth = image_header(file)[1].startswith(("I", "F"))
            require(not is_depth, f"{file}", "a photograph", "depth, one number per pixel")
            files.append(file)
        except (ValueError, OSError) as error:
            dropped.append(str(error))
    total = len(files) + len(dropped)
    if len(files) < _MIN_PHOTOGRAPHS:
        why = f"; {dropped[0]}" if dropped else ""
        raise ValueError(f"{path}: readable photographs must be at least 3, got {len(files)}{why}")
    folder = files[0].parent
    names = [file.name for file in files]
    for name in names:  # Spaces separate them in COLMAP's lists.
        spaced = any(map(str.isspace, name))
        require(not spaced, f"{folder}: names", "without spaces", repr(name), "rename the files")
    masks = sorted(file for file in mask_folder(folder).rglob("*") if file.is_file())
    version = import_pycolmap().__version__
    key = cache_key([*files, *masks], version, _MAX_SIZE, _SEED, config.partners, config.intrinsics)

    def register(written: Path) -> None:
        work = folder, names, _one_camera(files), config, written
        with resumable(lambda: "nothing is kept of the registration; the same command repeats it"):
            run_in_subprocess(f"{path}: registration", _register, work)

    model = cached_folder(cache_folder(config, "photographs", key) / "model", register)
    reconstruction = load_model(model)
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
    return open_model(path, "photographs", reconstruction, folder, config, dropped=tuple(dropped))


def _one_camera(files: list[Path]) -> bool:
    """Tells whether size, camera model and focal length are the same in all photographs."""
    cameras = set()
    for file in files:
        with Image.open(file) as image:
            exif = image.getexif()
            focal_length = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength)
            cameras.add((image.size, exif.get(ExifTags.Base.Model), focal_length))
    return len(cameras) == 1


def _register(work: tuple[Path, list[str], bool, CaptureConfig, Path]) -> None:
    """Writes the largest model, which does not depend on threads."""
    folder, names, is_one_camera, config, written = work
    temporary = written / "work"
    temporary.mkdir()
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(_SEED)
    pycolmap.logging.minloglevel = 2
    database = temporary / "database.db"
    mode = pycolmap.CameraMode.SINGLE if is_one_camera else pycolmap.CameraMode.AUTO
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions()
    if config.intrinsics:
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(map(str, config.intrinsics))
    pycolmap.import_images(database, folder, mode, names, reader)
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=_MAX_SIZE, use_gpu=False)
    # Enlarging the image first finds more in small ones and takes four times as long.
    small = max(max(image_header(folder / name)[0]) for name in names) < _SMALL
    extraction.sift.first_octave = -1 if small else 0
    if (masks := mask_folder(folder)).is_dir():
        reader.mask_path = masks
    for some in _batches(names, available_cores(), "extracting features", "photo"):
        pycolmap.extract_features(
            database, folder, some, reader_options=reader, extraction_options=extraction
        )
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    pairs, listed = _pairs(database, names, config.partners), temporary / "pairs.txt"
    for some in _batches(pairs, max(1, len(pairs) // 20), "matching pairs", "pair"):
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in some))
        pycolmap.match_image_pairs(
            database,
            matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
            verification_options=verification,
        )
    options = pycolmap.IncrementalPipelineOptions(random_seed=_SEED, num_threads=1)
    options.mapper.random_seed = options.triangulation.random_seed = _SEED
    options.mapper.num_threads = 1
    options.min_model_size = min(options.min_model_size, len(names))
    is_known = bool(config.intrinsics)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not is_known
    with Progress(total=len(names), desc="registering photographs", unit="photo") as progress:
        models = pycolmap.incremental_mapping(
            database,
            folder,
            temporary,
            options,
            initial_image_pair_callback=lambda: progress.update(2) and None,
            next_image_callback=lambda: progress.update() and None,
        )
    if not models:
        raise ValueError(
            f"{folder}: the {len(names)} photographs could not be registered; take them closer "
            "together, of a scene with texture, moving between them"
        )
    max(models.values(), key=lambda each: each.num_reg_images()).write(written)
    shutil.rmtree(temporary)


def _batches[Item](items: list[Item], size: int, what: str, unit: str) -> Iterator[list[Item]]:
    with Progress(total=len(items), desc=what, unit=unit) as progress:
        for batch in batched(items, size):
            yield list(batch)
            progress.update(len(batch))


def _pairs(database: Path, names: list[str], partners: int) -> list[tuple[int, int]]:
    if partners == 0:
        partners = len(names) if len(names) <= _MAX_EXHAUSTIVE else _PARTNERS
    if partners >= len(names) - 1:
        return list(combinations(range(len(names)), 2))
    with closing(import_pycolmap().Database.open(database)) as opened:
        return likely_pairs(similarity(opened, names), partners)


def likely_pairs(similarity: NDArray[np.float64], partners: int) -> list[tuple[int, int]]:
    """Returns sorted pairs of indices: each image with `partners` / 2 neighbors and those others
    whose `similarity` (N, N) is largest."""
    count, near = len(similarity), max(1, partners // 4)  # on either side
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + near + 1, count))}
    others = similarity.copy()
    np.fill_diagonal(others, -np.inf)
    for a, b in pairs:
        others[a, b] = others[b, a] = -np.inf
    for a, row in enumerate(others):
        for b in np.argsort(-row, kind="stable")[: max(partners - 2 * near, 0)]:
            if np.isfinite(row[b]):
                pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pairs)


def similarity(database: "pycolmap.Database", names: list[str]) -> NDArray[np.float64]:
    """Returns the cosines (N, N) between images of a database, each the sum of the differences of
    its descriptors from the nearest of 32 words (VLAD; Jegou et al. 2010)."""
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    features = []
    for name in names:
        descriptors = database.read_descriptors(numbers[name])  # which `data` does not keep alive
        features.append(np.array(descriptors.data))
    rng = np.random.default_rng(0)
    pool = np.concatenate(features)  # of 8 bits: thousands of photographs have gigabytes
    sample = _root_sift(pool[rng.permutation(len(pool))[:_SAMPLE]])
    words = min(_WORDS, len(sample))
    centers, _ = kmeans2(sample, words, iter=10, minit="points", rng=0)
    vectors = np.zeros((len(features), words, pool.shape[1]))
    for vector, descriptors in zip(vectors, features, strict=True):
        if len(descriptors):
            descriptors = _root_sift(descriptors)
            nearest, _ = vq(descriptors, centers)
            np.add.at(vector, nearest, descriptors - centers[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-12  # no word outweighs others
    flat = vectors.reshape(len(features), -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True) + 1e-12
    return flat @ flat.T


def _root_sift(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.sqrt(descriptors.astype(np.float32))


def is_video(path: Path) -> bool:
    """Tells whether a path is a video, by its suffix."""
    return path.is_file() and path.suffix.lower() in _VIDEO_SUFFIXES


def read_video(path: Path, config: CaptureConfig) -> Capture:
    """Opens frames of a video as photographs, see `read_photographs`; the cache keeps them."""
    folder = cache_folder(config, "videos", cache_key([path], config.video_rate)) / "frames"
    cached_folder(folder, lambda written: _extract_frames(path, config.video_rate, written))
    return read_photographs(folder, config)


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
                if not cv2.imwrite(str(file), frame, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]):
                    raise OSError(f"{file.name} is incomplete")
            index += 1
            progress.update()
    video.release()
    if count < _MIN_PHOTOGRAPHS:
        raise ValueError(
            f"{path}: {index} frames in {index / fps:.1f} s give {count} of {rate:g} a second, "
            f"fewer than {_MIN_PHOTOGRAPHS}; film longer, or increase capture.video_rate"
        )


def _sharpness(frame: NDArray) -> float:
    """Returns the variance of the Laplacian of a frame in small."""
    width = min(_SHARPNESS_WIDTH, frame.shape[1])
    size = width, max(1, frame.shape[0] * width // frame.shape[1])
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def triangulate(capture: Capture, numbers: Sequence[int]) -> SfmPoints:
    """Triangulates points between frames of a capture by pycolmap, with the capture's poses. SIFT
    features of each frame are matched with those of the next ten in order."""
    with tempfile.TemporaryDirectory(prefix="splatpilot-") as folder:
        images, masks = Path(folder) / "images", Path(folder) / "masks"
        for each in (images, masks, Path(folder) / "model"):
            each.mkdir()
        poses = {}
        for k, i in enumerate(Progress(numbers, "copying frames", unit="frame")):
            name = f"{k:06d}.png"
            valid = np.broadcast_to(capture.load_valid(i), (capture.height, capture.width))
            files = {
                images / name: cv2.cvtColor(capture.load_image(i), cv2.COLOR_RGB2BGR),
                masks / f"{name}.png": 255 * valid.astype(np.uint8),
            }
            for file, pixels in files.items():
                if not cv2.imwrite(str(file), pixels):
                    raise OSError(f"{file}: cannot be written; is the disk full?")
            poses[name] = capture.X_WCs[i].inverse().GetAsMatrix34()
        say(f"triangulating points between {len(poses)} images")
        work = Path(folder), capture.K, poses
        p_WQ, colors = run_in_subprocess(f"{folder}: triangulation", _triangulate, work)
    require(
        len(p_WQ) >= _MIN_POINTS,
        f"{capture.source}: the number of points between its images",
        f"at least {_MIN_POINTS}",
        len(p_WQ),
        "it has too little texture or overlap",
    )
    # Threads process images in any order, and points are numbered by it.
    order = np.lexsort(p_WQ.T)
    return SfmPoints(p_WQ[order], colors[order])


def _triangulate(
    work: tuple[Path, NDArray[np.float64], dict[str, NDArray[np.float64]]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points (n, 3) and colors (n, 3), 0 to 1, given the folder, K and X_CWs by name."""
    folder, K, poses = work
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)
    pycolmap.set_random_seed(0)
    database, images = folder / "database.db", folder / "images"
    # One thread each, for deterministic points.
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = _FEATURES
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", mask_path=folder / "masks")
    reader.camera_params = ",".join(f"{x:.17g}" for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    pycolmap.extract_features(
        database,
        images,
        list(poses),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as content:
        (camera,) = content.read_all_cameras()
        model.add_camera_with_trivial_rig(camera)
        for image in content.read_all_images():
            posed = pycolmap.Image(image.name, camera_id=camera.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(posed, pycolmap.Rigid3d(poses[image.name]))
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    pairing = pycolmap.SequentialPairingOptions(overlap=_OVERLAP, quadratic_overlap=False)
    pycolmap.match_sequential(database, matching, pairing)
    options = pycolmap.IncrementalPipelineOptions(extract_colors=True, num_threads=1, random_seed=0)
    model = pycolmap.triangulate_points(model, database, images, folder / "model", options=options)
    points = list(model.points3D.values())
    p_WQ = np.array([point.xyz for point in points]).reshape(-1, 3)
    return p_WQ, np.array([point.color for point in points]).reshape(-1, 3) / 255
