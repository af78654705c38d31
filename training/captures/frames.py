"""Opens captures that keep their frames in files.

Frames with a missing, damaged or differently sized file, or with an invalid or distant pose, are
left out and named in `Capture.dropped`. More than a fifth of those with an image are an error.
"""

import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from os.path import isfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.systems.common import readers
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.validation import errors_about, require
from splatpilot.training.captures.capture import (
    Capture,
    DepthCamera,
    FileAxes,
    Lens,
    all_valid,
    common_pinhole,
    no_depth,
    pinhole,
    resampling_maps,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.up_and_scale import make_metric, turn_upright

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}

_DEPTH = "one number per pixel, an integer of more than 8 bits or a float"
# Pillow's modes of images without depth; four channels may be the bytes of one number.
_NO_DEPTH = {"1", "L", "P", "LA", "PA", "RGB", "CMYK", "YCbCr"}
_ALPHA = {"RGBA", "LA", "PA"}
_ENDS = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}
_MAX_POSITION = 1e8  # [m]
_MAX_DROPPED = 0.2  # fraction of frames that may be left out
_MAPS = 8  # cameras whose resampling is kept at a time
_VALID = 0.999  # fraction of a resampled pixel that must come from valid ones
_SAME_SHAPE = 0.02  # relative difference of aspect ratios below which depth shows the same view


def existing_file(file: Path) -> Path:
    """Returns the file, or that of a name with \\ for / or accents that are composed otherwise."""
    if not file.exists():
        for name in (str(file), str(file).replace("\\", "/")):
            for form in ("NFC", "NFD"):
                if (found := Path(unicodedata.normalize(form, name))).exists():
                    return found
    return file


def first_file(*files: Path) -> Path | None:
    """Returns the first of the files that exists, if any."""
    return next((file for file in files if isfile(file)), None)


def image_header(file: Path) -> tuple[tuple[int, int], str]:
    """Returns width and height [px] of an image, and Pillow's mode, without decoding it."""
    readers.require_file(file)
    with readers.readable(file, "image"):
        with Image.open(file) as image:
            size, form, mode = image.size, image.format, image.mode
            # Of one color, or of those of a palette; OpenCV drops that of 16-bit depth.
            if "transparency" in image.info and not mode.startswith("I"):
                mode = "RGBA"
        with file.open("rb") as stream:
            # Cameras append previews and padding to JPEGs, so the end is searched.
            stream.seek(max(0, file.stat().st_size - 65536))
            if _ENDS.get(form or "", b"") not in stream.read():
                raise ValueError("its end is missing")
    readers.require_readable_size(file, 4 * size[0] * size[1])
    return size, mode


def _depth_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] of a depth image or array without reading its pixels."""
    if file.suffix == ".exr":
        (left, top), (right, bottom) = _open_exr(file, header_only=True).header()["dataWindow"]
        return int(right - left + 1), int(bottom - top + 1)
    if file.suffix == ".npy":
        shape, dtype = readers.array_layout(file)
        _require_depth(file, shape, dtype)
        return shape[1], shape[0]
    size, mode = image_header(file)
    require(mode not in _NO_DEPTH, f"{file}: depth", _DEPTH, f"an image of mode {mode}")
    return size


def _require_depth(file: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    valid = len(shape) == 2 and dtype.kind in "iuf" and dtype.itemsize > 1
    require(valid, f"{file}: depth", _DEPTH, f"an array of {dtype} of shape {shape}")


def read_image(file: Path) -> NDArray[np.uint8]:
    """Returns an image as (H, W, 3) red, green, blue."""
    # The pixels as stored: poses and intrinsics belong to them, not to the rotated picture.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return cv2.cvtColor(_decode(file, flags), cv2.COLOR_BGR2RGB)  # pyright: ignore[reportReturnType]


def _read_alpha(file: Path) -> NDArray[np.bool_]:
    """Returns the pixels (H, W) whose alpha is at least a half; all without any."""
    pixels = _decode(file, cv2.IMREAD_UNCHANGED)
    if pixels.ndim < 3 or pixels.shape[2] not in (2, 4):
        return np.ones(pixels.shape[:2], dtype=bool)
    largest = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    return 2 * pixels[..., -1].astype(float) >= largest


def read_depth(file: Path, unit: float) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from `.npy`, `.exr`, or an image of integers or floats, in `unit`
    per meter. NaN, negative depth and 65535 of 16 bits become 0, unknown."""
    if file.suffix == ".npy":
        raw = readers.read_array(file)
    elif file.suffix == ".exr":
        channels = _open_exr(file, separate_channels=True).channels()
        raw = np.asarray(next(iter(channels.values())).pixels, dtype=np.float32)
    else:
        raw = _decode(file, cv2.IMREAD_UNCHANGED)
    _require_depth(file, raw.shape, raw.dtype)
    depth = raw.astype(np.float32) / np.float32(unit)
    if raw.dtype == np.uint16:
        depth[raw == 65535] = 0
    return _drop_invalid(depth)


def read_packed_depth(file: Path, unit: float) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from a PNG whose four channels hold the bytes of a float32."""
    raw = _decode(file, cv2.IMREAD_UNCHANGED)
    valid = raw.ndim == 3 and raw.shape[2] == 4 and raw.dtype == np.uint8
    found = f"an array of {raw.dtype} of shape {raw.shape}"
    require(valid, f"{file}: depth", "four channels of 8 bits", found)
    depth = np.ascontiguousarray(raw).view("<f4")[..., 0].astype(np.float32)
    return _drop_invalid(np.divide(depth, np.float32(unit), dtype=np.float32))


def _drop_invalid(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    depth[np.isnan(depth) | (depth < 0)] = 0
    return depth


def _decode(file: Path, flags: int) -> NDArray:
    with readers.readable(file, "image"):
        image = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), flags)
        if image is None:
            raise ValueError("OpenCV cannot decode it")
    return image


def _open_exr(file: Path, **options: bool) -> Any:
    OpenEXR: Any = import_extra("OpenEXR", "exr")
    readers.require_file(file)
    with readers.readable(file, "EXR file"):
        return OpenEXR.File(str(file), **options)


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Returns the files of a folder by number, the group of a regular expression, in order."""
    if not folder.is_dir():
        raise FileNotFoundError(f"No such folder: {folder}")
    found = ((re.fullmatch(pattern, file.name), file) for file in folder.iterdir())
    files = {int(match[1]): file for match, file in found if match}
    if not files:
        raise FileNotFoundError(f"{folder}: holds no file named like {pattern}")
    return dict(sorted(files.items()))


def read_rows(file: Path, columns: int, what: str) -> list[NDArray[np.float64]]:
    """Returns the rows of numbers of a text file, each (columns,), called `what` in messages;
    without lines that start with # and empty lines at the end."""
    rows, text = [], readers.read_text(file, "replace").rstrip()
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("#"):
            continue
        try:
            row = np.array(line.split(), dtype=np.float64)
        except ValueError:
            row = np.array([])
        require(row.shape == (columns,), f"{file}, line {number}", what, repr(line[:80]))
        rows.append(row)
    return rows


def read_matrix(file: Path) -> NDArray[np.float64]:
    """Returns the matrix (4, 4) in a text file."""
    rows = read_rows(file, 4, "a row of a 4x4 matrix")
    require(len(rows) == 4, f"{file}", "a 4x4 matrix", f"{len(rows)} rows")
    return np.array(rows)


def pose_from_quaternion(row: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a row tx ty tz qx qy qz qw; errors start with `source`."""
    _require_position(row, row[:3], source)
    norm = np.linalg.norm(row[3:])
    remedy = "the order is tx ty tz qx qy qz qw"
    unit = abs(norm - 1) < 1e-3
    require(unit, f"{source}: the length of the quaternion", "1 +- 0.001", f"{norm:.6g}", remedy)
    return RigidTransform(RotationMatrix(Rotation.from_quat(row[3:]).as_matrix()), row[:3])


def pose_row(X: RigidTransform) -> str:
    """Returns a pose as a text tx ty tz qx qy qz qw."""
    xyzw = Rotation.from_matrix(X.rotation().matrix()).as_quat(canonical=True)
    return " ".join(f"{number:.17g}" for number in (*X.translation(), *xyzw))


def pose_from_matrix(matrix: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a matrix (4, 4) or (3, 4), rounded; errors start with `source`."""
    R, p = matrix[:3, :3], matrix[:3, 3]
    _require_position(matrix, p, source)
    last = (0.0, 0.0, 0.0, 1.0)
    columns = np.allclose(matrix[:, 3], last[: len(matrix)], atol=1e-6)
    require(
        np.allclose(matrix[3:], last, atol=1e-6),
        f"{source}: the last row of a pose",
        "0 0 0 1",
        matrix[-1].tolist(),
        "the matrix is stored column by column, transpose it" if columns else "copy it again",
    )
    error, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    require(
        error < 0.01 and determinant > 0,
        f"{source}: the rotation",
        "orthonormal and right-handed",
        f"R R^T - I of {error:.2g} and determinant {determinant:.3g}",
    )
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


def _require_position(pose: NDArray[np.float64], p: NDArray[np.float64], source: str) -> None:
    if not np.isfinite(pose).all():
        raise ValueError(f"{source}: the pose is not finite (tracking was lost?)")
    inside = np.abs(p).max() <= _MAX_POSITION
    require(inside, f"{source}: the position", f"within {_MAX_POSITION:g} m", p)


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame of a capture, not yet inspected."""

    image: Path
    X_FB: Callable[[], RigidTransform]
    """Returns the pose as the file gives it, or raises ValueError that names the file: that of a
    body B, the camera with the file's axes, in the file's world F."""
    depth: Path | None = None
    lens: Lens | None = None  # the camera of this frame; None takes that of the capture
    mask: Path | None = None  # an image that is black where this one is not to be used
    name: str = ""  # path of the image as the files give it; empty for the name of the file
    confidence: Path | None = None  # an image that is 0 where depth is a guess
    held_out: bool = False  # true if the files hold this frame out from training


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame whose files look complete."""

    files: FrameFiles
    size: tuple[int, int]  # width and height [px]
    depth_size: tuple[int, int] | None
    has_alpha: bool
    X_FB: RigidTransform


def open_frames(
    path: Path,
    source: str,
    frames: Sequence[FrameFiles],
    *,
    axes: FileAxes,
    config: CaptureConfig | None = None,
    lens: Callable[[int, int], Lens] | None = None,
    depth_unit: float = 1000.0,
    read_depth: Callable[[Path, float], NDArray[np.float32]] = read_depth,
    depth_camera: Callable[[int, int], DepthCamera] | None = None,
    stretch_depth: bool = False,
    up: str = "z",
    dropped: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Capture:
    """Opens frames, whose images and depths are read on demand.

    `intrinsics`, `depth_intrinsics`, `p_DC`, `depth_unit` and `up` of `config` replace those of the
    format. `lens` and `depth_camera` return the cameras of images and depth images of a width and
    height [px], for frames without their own; without `depth_camera` depth has the pixels of the
    images before they are undistorted or, if `stretch_depth`, another resolution. `read_depth`
    reads a file of `depth_unit` units per meter. `up` is that of the files' world, see
    `turn_upright`; empty leaves it and its scale as they are. `dropped` are messages about frames
    left out already.
    """
    config = config or CaptureConfig()
    if depth_camera is None and config.depth_intrinsics:
        X_CD = RigidTransform(-np.array(config.p_DC or [0.0, 0.0, 0.0]))
        depth_camera = partial(DepthCamera, pinhole(*config.depth_intrinsics), X_CD=X_CD)
        stretch_depth = False
    messages, complete, missing = list(dropped), [], 0
    for files in frames:
        try:
            complete.append(_inspect(files))
        except (ValueError, OSError) as error:
            messages.append(str(error))
            missing += not existing_file(files.image).exists()
    registered = depth_camera is None and not stretch_depth
    same_size = _drop_other_sizes(complete, messages, registered, stretch_depth)
    usable = _drop_distant(same_size, messages)
    # Images that someone has deleted, such as blurred ones, are no sign of a wrong reading.
    if len(usable) < max(2, (1 - _MAX_DROPPED) * (len(frames) - missing)):
        first = f"; the first that cannot: {messages[0]}" if messages else ""
        raise ValueError(
            f"{path}: {len(usable)} of {len(frames) - missing} frames can be used, at least 2 and "
            f"{1 - _MAX_DROPPED:.0%} must be{first}"
        )

    @cache
    def shared_lens(width: int, height: int) -> Lens:
        if config.intrinsics:
            return Lens(pinhole(*config.intrinsics), width, height, source="capture.intrinsics")
        if lens is None:
            raise ValueError("unknown intrinsics; set capture.intrinsics to [fx, fy, cx, cy]")
        return lens(width, height)

    with errors_about(path):
        lenses = [frame.files.lens or shared_lens(*frame.size) for frame in usable]
        distinct = list(dict.fromkeys(lenses))
        camera = common_pinhole(distinct)
    # Some cameras focus every frame again: the maps of all would fill the memory.
    cached_maps = lru_cache(_MAPS)(lambda lens: resampling_maps(lens, camera))

    def load_image(i: int) -> NDArray[np.uint8]:
        file = usable[i].files.image
        return resample(_require_size(read_image(file), file, usable[i].size), i, cv2.INTER_LINEAR)

    def load_valid(i: int) -> NDArray[np.bool_]:
        files, size = usable[i].files, usable[i].size
        mask = np.ones(size[::-1], dtype=bool)
        if files.mask is not None:
            shown = _decode(files.mask, cv2.IMREAD_ANYDEPTH) > 0
            mask &= _require_size(shown, files.mask, size)
        if usable[i].has_alpha:
            mask &= _require_size(_read_alpha(files.image), files.image, size)
        # A pixel interpolated from an invalid one is invalid.
        return resample(mask.astype(np.float32), i, cv2.INTER_LINEAR) > _VALID

    def load_depth(i: int) -> NDArray[np.float32] | None:
        file, size = usable[i].files.depth, usable[i].depth_size
        if file is None or size is None:
            return None
        depth = _require_size(read_depth(file, config.depth_unit or depth_unit), file, size)
        if (confidence := usable[i].files.confidence) is not None:
            shown = _decode(confidence, cv2.IMREAD_ANYDEPTH)
            shown = cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST_EXACT)
            depth = np.where(shown > 0, depth, np.float32(0))
        if depth_camera:
            return depth
        # An average between two surfaces would lie on neither.
        if size != usable[i].size:
            depth = cv2.resize(depth, usable[i].size, interpolation=cv2.INTER_NEAREST_EXACT)
        return resample(depth, i, cv2.INTER_NEAREST)

    def resample(image: NDArray, i: int, interpolation: int) -> NDArray:
        if (maps := cached_maps(lenses[i])) is None:
            return image
        # The pinhole sees up to half a pixel more than the lens, which is not black.
        return cv2.remap(image, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE)

    R_WF, R_BC = RigidTransform(axes.R_WF), RigidTransform(axes.R_BC)
    depth_size = next((frame.depth_size for frame in usable if frame.depth_size), None)
    held_out = [i for i, frame in enumerate(usable) if frame.files.held_out]
    masked = sum(frame.files.mask is not None for frame in usable)
    transparent = sum(frame.has_alpha for frame in usable)
    capture = Capture(
        name=path.resolve().name,
        source=f"{source} {path.resolve()}",
        K=camera.K,
        width=camera.width,
        height=camera.height,
        X_WCs=[R_WF @ frame.X_FB @ R_BC for frame in usable],
        load_image=load_image,
        load_depth=load_depth if depth_size else no_depth,
        load_valid=load_valid if masked or transparent else all_valid,
        depth_camera=depth_camera(*depth_size) if depth_camera and depth_size else None,
        frame_names=[frame.files.name or frame.files.image.name for frame in usable],
        dropped=messages,
        held_out=held_out if any(frame.held_out for frame in frames) else None,
        notes=[*notes, *_notes(distinct, masked, transparent, len(usable))],
        axes=axes,
    )
    if not up:
        return capture
    if config.scale.sources():
        capture = make_metric(capture, config.scale)
    return turn_upright(capture, config.up or up)


def _notes(lenses: Sequence[Lens], masked: int, transparent: int, total: int) -> list[str]:
    notes = [f"intrinsics: {lenses[0]}"]
    if len(lenses) > 1:
        notes[0] += f", and {len(lenses) - 1} more cameras"
    centers = [(lens.K[:2, 2], np.array([lens.width, lens.height])) for lens in lenses]
    if far := [center for center, size in centers if (np.abs(center / size - 0.5) > 0.25).any()]:
        cx, cy = far[0].round(1).tolist()
        notes.append(
            f"the principal point ({cx}, {cy}) px is far from the center of the images; are "
            "intrinsics those of images of this size?"
        )
    for count, what, pixels in (
        (masked, "a mask", "black pixels"),
        (transparent, "an alpha channel", "pixels of less than a half"),
    ):
        if count:
            notes.append(f"{count} of {total} images have {what}; {pixels} are not used")
    return notes


def _inspect(frame: FrameFiles) -> _Frame:
    parts = ("image", "depth", "mask")
    found = {name: file and existing_file(file) for name in parts if (file := getattr(frame, name))}
    frame = replace(frame, **found)
    size, mode = image_header(frame.image)
    if frame.lens is not None:
        _check_size(frame.image, size, (frame.lens.width, frame.lens.height))
    if frame.mask is not None:
        _check_size(frame.mask, image_header(frame.mask)[0], size)
    depth_size = _depth_size(frame.depth) if frame.depth is not None else None
    return _Frame(frame, size, depth_size, mode in _ALPHA, frame.X_FB())


def _drop_other_sizes(
    frames: Sequence[_Frame], messages: list[str], registered: bool, same_view: bool
) -> list[_Frame]:
    """Returns the frames in the most frequent sizes of images and depth. Depth must have the size
    of its image if `registered`, its aspect ratio if `same_view`."""
    sizes = [frame.size for frame in frames if frame.files.lens is None]
    depth_sizes = [frame.depth_size for frame in frames if frame.depth_size]
    usual, usual_depth = (max(each, key=each.count, default=None) for each in (sizes, depth_sizes))
    kept = []
    for frame in frames:
        (width, height), (w, h) = frame.size, frame.depth_size or frame.size
        try:
            if frame.files.lens is None and usual is not None:
                _check_size(frame.files.image, frame.size, usual)
            expected = frame.size if registered else usual_depth
            if frame.files.depth and frame.depth_size and expected:
                _check_size(frame.files.depth, frame.depth_size, expected)
            if same_view and abs(w * height - h * width) > _SAME_SHAPE * w * height:
                raise ValueError(
                    f"{frame.files.depth}: {w}x{h} pixels of depth do not show what "
                    f"{width}x{height} pixels of an image do; width and height must have one ratio"
                )
            kept.append(frame)
        except ValueError as error:
            messages.append(str(error))
    return kept


def _drop_distant(frames: list[_Frame], messages: list[str]) -> list[_Frame]:
    """Drops frames that are over 10 m and 20 times the 80 % quantile from the median position."""
    if not frames:
        return frames
    p = np.array([frame.X_FB.translation() for frame in frames])
    distance = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    distant = distance > max(10.0, 20 * np.quantile(distance, 0.8))
    for i in np.flatnonzero(distant):
        image = frames[i].files.image
        messages.append(f"{image}: its position {p[i].round(1)} is far from all others")
    return [frame for frame, far in zip(frames, distant, strict=True) if not far]


def _check_size(file: Path, size: tuple[int, int], expected: tuple[int, int]) -> None:
    condition = f"of {expected[0]}x{expected[1]} pixels, as the others"
    require(size == expected, f"{file}", condition, f"{size[0]}x{size[1]}")


def _require_size(array: NDArray, file: Path, size: tuple[int, int]) -> NDArray:
    _check_size(file, array.shape[1::-1], size)
    return array
