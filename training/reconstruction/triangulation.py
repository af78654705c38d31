"""Points of a place from posed images alone: features matched and triangulated, no depth needed."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.processes import run_apart
from splatpilot.systems.progress import Progress, say
from splatpilot.training.captures.capture import Capture, SfmPoints
from splatpilot.training.captures.colmap import import_pycolmap

if TYPE_CHECKING:
    import pycolmap

_OVERLAP = 10  # images after each one that it is matched with
_FEATURES = 2048  # at most, of an image


def triangulate(capture: Capture, numbers: Sequence[int]) -> SfmPoints:
    """Returns the points that pycolmap triangulates between some frames of a capture, whose poses
    and intrinsics are taken as they are.

    SIFT features of each frame are matched with those of the next ten in order.

    Raises:
        ValueError: if fewer than 100 points are found.
        OSError: if the images cannot be read, or copied into the system's temporary folder, or that
            has no room for what pycolmap keeps there.
    """
    with tempfile.TemporaryDirectory(prefix="splatpilot-") as folder:
        images = Path(folder) / "images"
        for part in (images, images.parent / "masks"):
            part.mkdir()
        names = [f"{k:06d}.png" for k in range(len(numbers))]
        for name, i in zip(Progress(names, "copying frames", unit="frame"), numbers, strict=True):
            image = capture.load_image(i)
            if not cv2.imwrite(str(images / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
                raise OSError(f"{images / name}: cannot be written; is the disk full?")
            valid = np.broadcast_to(capture.load_valid(i), (capture.height, capture.width))
            mask = images.parent / "masks" / f"{name}.png"
            if not cv2.imwrite(str(mask), 255 * valid.astype(np.uint8)):
                raise OSError(f"{mask}: cannot be written; is the disk full?")
        poses = {
            name: capture.X_WCs[i].inverse().GetAsMatrix34()
            for name, i in zip(names, numbers, strict=True)
        }
        say(f"triangulating points between {len(names)} images")
        work = Path(folder), capture.K, poses
        p_WQ, colors = run_apart(f"{folder}: triangulation", _triangulated, work)
    if len(p_WQ) < 100:
        raise ValueError(
            f"{capture.source}: only {len(p_WQ)} points can be triangulated between its images, "
            "100 are needed; it has too little texture or its frames see too different things"
        )
    # Threads hand images and matches over in any order, and points are numbered by it.
    order = np.lexsort(p_WQ.T)
    return SfmPoints(p_WQ[order], colors[order])


def _triangulated(
    work: tuple[Path, NDArray[np.float64], dict[str, NDArray[np.float64]]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points (n, 3) and their colours (n, 3), 0 to 1.

    Args:
        work: a folder with `images`, their intrinsics (3, 3) [px], and their poses X_CW (3, 4) by
            name.
    """
    folder, K, poses = work
    pycolmap = import_pycolmap()
    # COLMAP logs every image on standard error.
    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)
    pycolmap.set_random_seed(0)
    database, images = folder / "database.db", folder / "images"
    model = _make_posed_model(K, poses, database, images)
    pairing = pycolmap.SequentialPairingOptions(overlap=_OVERLAP, quadratic_overlap=False)
    # One thread each: others would make the order of images and matches, and with it the last
    # digits of the points, a matter of chance.
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    pycolmap.match_sequential(database, matching, pairing)
    (folder / "model").mkdir()
    options = pycolmap.IncrementalPipelineOptions(extract_colors=True, num_threads=1, random_seed=0)
    model = pycolmap.triangulate_points(model, database, images, folder / "model", options=options)
    points = list(model.points3D.values())
    p_WQ = np.array([point.xyz for point in points]).reshape(-1, 3)
    return p_WQ, np.array([point.color for point in points]).reshape(-1, 3) / 255


def _make_posed_model(
    K: NDArray[np.float64], poses: dict[str, NDArray[np.float64]], database: Path, images: Path
) -> "pycolmap.Reconstruction":
    """Extracts features into the database and returns a model of the cameras, without points."""
    pycolmap = import_pycolmap()
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _FEATURES
    extraction.num_threads = 1
    pycolmap.extract_features(
        database,
        images,
        list(poses),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(
            camera_model="PINHOLE",
            camera_params=",".join(f"{x:.17g}" for x in parameters),
            mask_path=images.parent / "masks",
        ),
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as content:
        (camera,) = content.read_all_cameras()
        model.add_camera_with_trivial_rig(camera)
        for image in content.read_all_images():
            model.add_image_with_trivial_frame(
                pycolmap.Image(
                    name=image.name, camera_id=camera.camera_id, image_id=image.image_id
                ),
                pycolmap.Rigid3d(poses[image.name]),
            )
    return model
