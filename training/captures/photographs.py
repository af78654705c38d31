"""Photographs alone, registered with pycolmap: SIFT, matching, incremental mapping.

The registration is kept in a cache under a name made from the photographs, so that it happens once.
"""

import shutil
from pathlib import Path

from PIL import Image

from splatpilot.systems.cores import available_cores
from splatpilot.systems.files import folder_written_atomically
from splatpilot.systems.processes import run_apart
from splatpilot.systems.progress import Progress, resumable
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_cache import cache_folder, cache_key, prepare_cache
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.colmap import (
    capture_of_model,
    import_pycolmap,
    mask_folder,
    read_model,
)
from splatpilot.training.captures.image_files import IMAGE_SUFFIXES, image_size
from splatpilot.training.captures.image_pairs import all_pairs, likely_pairs, similarity

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
