"""A capture with refined poses, which are kept in a cache, as refining takes a minute."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.files import written_atomically
from splatpilot.systems.progress import Progress, say
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_cache import cache_folder, cache_key, prepare_cache
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frame_comparison import WIDTH, ComparedFrame
from splatpilot.training.captures.pose_refinement import refine_poses
from splatpilot.training.captures.shrink_frame import shrink, shrink_factor

_VERSION = 1
"""Of what `refine_poses` makes of the same frames; another is refined anew."""


def refined_capture(capture: Capture, path: Path, config: CaptureConfig) -> Capture:
    """Returns a capture with the poses of `refine_poses`, from the cache or put there.

    All its frames have a part in that, those too by which a scene is judged later, as all
    photographs have in structure from motion.

    Args:
        capture: what was read.
        path: from where.
        config: how.

    Raises:
        ValueError: if it has no depth, or no two frames see the same.
        OSError: if the cache cannot be written.
    """
    if not capture.has_depth:
        raise ValueError(
            f"{path}: capture.refine_poses compares depth, and this capture has none; leave it out"
        )
    file = cache_folder(config, "poses") / f"poses-{_key(capture, path)}.npy"
    if not file.is_file():
        prepare_cache(file.parent)
        factor = shrink_factor(capture.width, WIDTH)
        numbers = Progress(range(len(capture)), "loading frames", unit="frame")
        frames = [ComparedFrame.of(shrink(capture.frame(i), factor)) for i in numbers]
        try:
            refined = refine_poses(frames, capture.X_WCs)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        say(f"{path}: {refined}")
        with written_atomically(file) as written, written.open("wb") as stream:
            np.save(stream, np.array([X_WC.GetAsMatrix34() for X_WC in refined.X_WCs]))
    return replace(capture, X_WCs=[_pose(matrix) for matrix in np.load(file)])


def _pose(matrix: np.ndarray) -> RigidTransform:
    return RigidTransform(RotationMatrix(matrix[:, :3]), matrix[:, 3])


def _key(capture: Capture, path: Path) -> str:
    """Names a capture by its files and by how they were read."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    said = [capture.K, *(X_WC.GetAsMatrix34() for X_WC in capture.X_WCs)]
    if capture.depth_camera is not None:
        said += [capture.depth_camera.K, capture.depth_camera.X_CD.GetAsMatrix34()]
    read = hashlib.sha256(b"".join(each.tobytes() for each in said)).hexdigest()
    return cache_key((file for file in files if file.is_file()), _VERSION, np.__version__, read)
