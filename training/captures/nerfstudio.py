"""Captures in nerfstudio's `transforms.json`.

As nerfstudio documents it: `transform_matrix` takes camera axes of OpenGL (x right, y up, z back)
to a world with z up; intrinsics and distortion are given once or with each frame; depth is planar
in units of `depth_unit_scale_factor` (0.001); masks are black where pixels are not to be used.
ScanNet++ adds `is_bad` and `test_frames`. Lengths are taken to be in meters if there is depth.
"""

import dataclasses
import json
from os.path import isfile
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.common.readers import error_summary, read_ply_file, read_text, readable
from splatpilot.systems.common.validation import require
from splatpilot.training.captures.capture import (
    OPENGL_AXES,
    Capture,
    Lens,
    SfmPoints,
    fisheye_lens,
    opencv_lens,
    pinhole,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.frames import (
    IMAGE_SUFFIXES,
    FrameFiles,
    existing_file,
    image_header,
    open_frames,
    pose_from_matrix,
)
from splatpilot.training.captures.up_and_scale import make_metric, turn_upright

_TRANSFORMS = "transforms.json"
_MAX_DISTORTION = 100.0
_FISHEYE = "OPENCV_FISHEYE"
# Perspective models differ in the terms of distortion that are given.
_MODELS = ("OPENCV", _FISHEYE, "PINHOLE", "RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_SPLIT = {part: f"{part}_filenames" for part in ("train", "val", "test")}
_CAMERA = {"camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "is_fisheye"}
_CAMERA |= {*_DISTORTION, "distortion_params", "fisheye_crop_radius"}
# Including keys that tell only how the file was made.
_KNOWN = _CAMERA | {*_SPLIT.values(), "frames", "test_frames", "depth_unit_scale_factor"}
_KNOWN |= {"ply_file_path", "applied_transform", "applied_scale"}
_KNOWN_IN_FRAMES = _CAMERA | {"file_path", "transform_matrix", "depth_file_path", "mask_path"}
_KNOWN_IN_FRAMES |= {"is_bad", "colmap_im_id"}


def recognizes(path: Path) -> bool:
    """Tells whether a folder holds a `transforms.json`."""
    return (path / _TRANSFORMS).exists()


def read(path: Path, config: CaptureConfig) -> Capture:
    """Opens a capture in nerfstudio's format."""
    file = path / _TRANSFORMS
    text = read_text(file)
    with readable(file, "file of nerfstudio's format with `frames`"):
        content = json.loads(text)
        entries, held_out = _split(content)
        named = [(str(entry["file_path"]), entry["transform_matrix"], entry) for entry in entries]
        meters = float(content.get("depth_unit_scale_factor", 1e-3))
        require(1e-9 < meters < 1e9, "depth_unit_scale_factor", "in (1e-9, 1e9) m", meters)
        points = path / (content.get("ply_file_path") or "")
        depths, masks = (
            [path / entry[key] if entry.get(key) else None for entry in entries]
            for key in ("depth_file_path", "mask_path")
        )
    lenses: dict[tuple, Lens] = {}  # Equal cameras share one, and one resampling.
    frames, bad = [], []
    for i, (name, matrix, entry) in enumerate(named):
        if entry.get("is_bad") or held_out[i] is None:
            bad.append(f"{file}: {name} {'is_bad' if entry.get('is_bad') else 'is in no split'}")
            continue
        image = _image_file(existing_file(path / name))
        frames.append(
            FrameFiles(
                image,
                lambda matrix=matrix, source=f"{file}, frame {i} ({name})": _pose(matrix, source),
                depths[i],
                _lens(file, {**content, **entry}, image, config, lenses),
                masks[i],
                name=_name(name),
                held_out=bool(held_out[i]),
            )
        )
    unused = content.keys() - _KNOWN | set().union(*entries) - _KNOWN_IN_FRAMES
    capture = open_frames(
        path,
        "nerfstudio capture",
        frames,
        axes=OPENGL_AXES,
        config=config,
        depth_unit=1 / meters,
        stretch_depth=True,
        up="",
        dropped=bad,
        notes=[f"{file.name}: {', '.join(sorted(unused))} is not used"] if unused else (),
    )
    if points != path:
        capture = dataclasses.replace(capture, points=_read_points(points))
    if config.scale.sources() or not capture.has_depth:
        capture = make_metric(capture, config.scale)
    return turn_upright(capture, config.up or "z")


def _split(content: dict[str, Any]) -> tuple[list[dict[str, Any]], list[bool | None]]:
    """Returns the frames, and whether the file holds each out; None if its split leaves it out."""
    frames = [dict(entry) for entry in content["frames"]]
    tests = content.get("test_frames") or []  # frames themselves, or names of others
    added = [dict(entry) for entry in tests if not isinstance(entry, str)]
    names = [_name(entry["file_path"]) for entry in frames + added]
    parts = {part: set(map(_name, content[key])) for part, key in _SPLIT.items() if key in content}
    held_out = {_name(each) for each in tests if isinstance(each, str)}.union(
        names[len(frames) :], parts.get("val", ()), parts.get("test", ())
    )
    fitted = parts.get("train", set(names))
    if unknown := (fitted | held_out).difference(names):
        raise ValueError(f"its split names {min(unknown)}, which is not the name of a frame")
    roles = [name in held_out if name in held_out | fitted else None for name in names]
    if False not in roles:
        raise ValueError("its split leaves no frame to train with")
    return frames + added, roles


def _name(path: Any) -> str:
    return str(PurePath(str(path)))


def _pose(matrix: Any, source: str) -> RigidTransform:
    try:
        array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    valid = array.shape in ((4, 4), (3, 4))
    require(valid, f"{source}: transform_matrix", "a 4x4 matrix", f"{matrix!r:.40}")
    return pose_from_matrix(array, source)


def _image_file(file: Path) -> Path:
    """Returns the file of an image, whose name may be without its suffix."""
    if isfile(file) or file.suffix.lower() in IMAGE_SUFFIXES or not file.parent.is_dir():
        return file
    return next((f for f in sorted(file.parent.iterdir()) if f.stem == file.name), file)


def _lens(
    file: Path,
    values: dict[str, Any],
    image: Path,
    config: CaptureConfig,
    lenses: dict[tuple, Lens],
) -> Lens | None:
    """Returns the camera that `values` describe, None without the image's size."""
    model = str(values.get("camera_model", _FISHEYE if values.get("is_fisheye") else "OPENCV"))
    require(model in _MODELS, f"{file}: camera_model", f"one of {', '.join(_MODELS)}", model)
    try:
        if "w" in values and "h" in values:
            width, height = int(values["w"]), int(values["h"])
        else:
            width, height = image_header(image)[0]
        if config.intrinsics:
            fx, fy, cx, cy = config.intrinsics
        else:
            if "fl_x" not in values:
                values["fl_x"] = width / 2 / np.tan(float(values["camera_angle_x"]) / 2)
            fx = float(values["fl_x"])
            fy = float(values.get("fl_y", fx))
            cx, cy = (float(values.get(k, n / 2)) for k, n in (("cx", width), ("cy", height)))
        listed = dict(zip(_DISTORTION, values.get("distortion_params") or (), strict=False))
        distortion = tuple(float({**values, **listed}.get(k, 0.0)) for k in _DISTORTION)
        valid = np.abs(distortion).max() <= _MAX_DISTORTION
        require(valid, "the distortion", f"within {_MAX_DISTORTION:g}", distortion)
        radius = float(values.get("fisheye_crop_radius") or np.inf) if model == _FISHEYE else np.inf
        key = (model, width, height, fx, fy, cx, cy, distortion, radius)
        if key not in lenses:
            K, (k1, k2, k3, k4, p1, p2) = pinhole(fx, fy, cx, cy), distortion
            if model == _FISHEYE:
                lens = fisheye_lens(K, width, height, (k1, k2, k3, k4))
            else:
                lens = opencv_lens(K, width, height, (k1, k2, p1, p2, k3), k4)
            given = file.name if {"cx", "cy"} <= values.keys() else f"{file.name}, centered"
            source = "capture.intrinsics" if config.intrinsics else given
            lenses[key] = dataclasses.replace(lens, radius=radius, source=source)
        return lenses[key]
    except OSError:
        return None
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{file}: invalid camera of {image.name} ({error_summary(error)}); it must have w, h, "
            "fl_x, fl_y, cx and cy, or camera_angle_x"
        ) from None


def _read_points(file: Path) -> SfmPoints:
    content = read_ply_file(file)
    with readable(file, "PLY file of colored points"):
        vertices = content["vertex"]
        p_WQ = np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
        colors = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
        if not (np.isfinite(p_WQ).all() and np.isfinite(colors).all()):
            raise ValueError("points or colors are not finite")
    return SfmPoints(p_WQ, colors.astype(np.float64) / 255)
