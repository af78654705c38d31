"""Opens captures that keep their frames in files.

Frames with a missing, damaged or differently sized file, or with an invalid or distant pose, are
left out, with a message each in `Capture.dropped`. More than a fifth of them are an error, because
then the capture is read wrongly.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from os.path import isfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.readers import (
    array_layout,
    read_array,
    read_text,
    reason_of,
    require_readable_size,
)
from splatpilot.systems.common.validation import require
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

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}

_DEPTH = "one number per pixel, an integer of more than 8 bits or a float"
# Pillow's modes of images without depth; four channels may be the bytes of one number.
_NO_DEPTH = {"1", "L", "P", "LA", "PA", "RGB", "CMYK", "YCbCr"}
_ALPHA = {"RGBA", "LA", "PA"}
_ENDS = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}
_MAX_POSITION = 1e8  # [m]


def image_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] of an image without decoding it.

    Raises:
        ValueError, OSError: if it is missing, not an image or truncated.
    """
    return _image_header(file)[0]


def _image_header(file: Path) -> tuple[tuple[int, int], str]:
    """Returns width and height [px], and Pillow's mode of the pixels."""
    _require_content(file)
    try:
        with Image.open(file) as image:
            size, kind, mode = image.size, image.format, image.mode
            if "transparency" in image.info:  # of one color, or of those of a palette
                mode = "RGBA"
    except Exception as error:  # Pillow raises anything of damaged files
        reason = reason_of(error).partition(" '")[0]
        raise ValueError(f"{file}: not a readable image ({reason}); copy it again") from None
    require_readable_size(file, 4 * size[0] * size[1])
    with file.open("rb") as stream:
        # Cameras append previews and padding to JPEGs, so the end is searched.
        stream.seek(max(0, file.stat().st_size - 65536))
        if _ENDS.get(kind or "", b"") not in stream.read():
            raise ValueError(f"{file}: not a readable image (truncated); copy it again")
    return size, mode


def depth_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] of a depth image or array without reading its pixels."""
    _require_content(file)
    if file.suffix == ".exr":
        (left, top), (right, bottom) = _open_exr(file, header_only=True).header()["dataWindow"]
        return int(right - left + 1), int(bottom - top + 1)
    if file.suffix == ".npy":
        shape, dtype = array_layout(file)
        valid = len(shape) == 2 and dtype.kind in "iuf" and dtype.itemsize > 1
        require(valid, f"{file}: depth", _DEPTH, f"an array of {dtype} of shape {shape}")
        return shape[1], shape[0]
    size, mode = _image_header(file)
    require(mode not in _NO_DEPTH, f"{file}: depth", _DEPTH, f"an image of mode {mode}")
    return size


def read_image(file: Path) -> NDArray[np.uint8]:
    """Returns an image as (H, W, 3) red, green, blue."""
    # The pixels as stored: poses and intrinsics belong to them, not to the rotated
    # picture.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return cv2.cvtColor(_decode(file, flags), cv2.COLOR_BGR2RGB)  # pyright: ignore[reportReturnType]


def read_alpha(file: Path) -> NDArray[np.bool_]:
    """Returns where the alpha (H, W) of an image is at least a half; everywhere without any."""
    pixels = _decode(file, cv2.IMREAD_UNCHANGED)
    if pixels.ndim < 3 or pixels.shape[2] not in (2, 4):
        return np.ones(pixels.shape[:2], dtype=bool)
    largest = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    return 2 * pixels[..., -1].astype(float) >= largest


def read_mask(file: Path) -> NDArray[np.bool_]:
    """Returns where a mask (H, W) is not black."""
    return _decode(file, cv2.IMREAD_ANYDEPTH) > 0


def read_depth(file: Path, unit: float) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from `.npy`, `.exr`, or an image of integers or floats.

    NaN, negative depth and the largest 16-bit number, which sensors write where they see nothing,
    become 0, unknown.

    Args:
        unit: units of the file per meter.
    """
    if file.suffix == ".npy":
        raw = read_array(file)
    elif file.suffix == ".exr":
        channels = _open_exr(file, separate_channels=True).channels()
        raw = np.asarray(next(iter(channels.values())).pixels, dtype=np.float32)
    else:
        raw = _decode(file, cv2.IMREAD_UNCHANGED)
    valid = raw.ndim == 2 and raw.dtype.kind in "iuf" and raw.dtype.itemsize > 1
    require(valid, f"{file}: depth", _DEPTH, f"an array of {raw.dtype} of shape {raw.shape}")
    depth = raw.astype(np.float32) / np.float32(unit)
    if raw.dtype == np.uint16:
        depth[raw == 65535] = 0
    return _clean(depth)


def read_packed_depth(file: Path) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from a PNG whose four channels hold the bytes of a float32."""
    raw = _decode(file, cv2.IMREAD_UNCHANGED)
    valid = raw.ndim == 3 and raw.shape[2] == 4 and raw.dtype == np.uint8
    found = f"an array of {raw.dtype} of shape {raw.shape}"
    require(valid, f"{file}: depth", "four channels of 8 bits", found)
    return _clean(np.ascontiguousarray(raw).view("<f4")[..., 0].copy())


def _clean(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    depth[np.isnan(depth) | (depth < 0)] = 0
    return depth


def _decode(file: Path, flags: int) -> NDArray:
    raw = np.frombuffer(file.read_bytes(), np.uint8)
    try:
        image = cv2.imdecode(raw, flags) if len(raw) else None
    except cv2.error:  # more pixels than OpenCV decodes
        image = None
    if image is None:
        raise ValueError(f"{file}: not a readable image; copy it again")
    return image


def _open_exr(file: Path, **options: bool) -> Any:
    OpenEXR: Any = import_extra("OpenEXR", "exr")
    try:
        return OpenEXR.File(str(file), **options)
    except Exception as error:  # OpenEXR raises anything of damaged files
        raise ValueError(f"{file}: not a readable EXR file ({error}); copy it again") from None


def _require_content(file: Path) -> None:
    if not isfile(file):
        raise FileNotFoundError(f"No such file: {file}")
    if file.stat().st_size == 0:
        raise ValueError(f"{file}: the file is empty; copy it again")


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Returns the files of a folder by the number in their name, in its order.

    Args:
        pattern: regular expression of the whole name, whose group is the number.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"No such folder: {folder}")
    found = ((re.fullmatch(pattern, file.name), file) for file in folder.iterdir())
    files = {int(match[1]): file for match, file in found if match}
    if not files:
        raise FileNotFoundError(f"{folder}: holds no file named like {pattern}")
    return dict(sorted(files.items()))


def read_rows(file: Path, columns: int, what: str) -> list[NDArray[np.float64]]:
    """Returns the rows of numbers of a text file, each (columns,); NaN is read as such.

    Lines that start with # and empty lines at the end are left out.

    Args:
        what: a row is, for messages.
    """
    rows = []
    for number, line in enumerate(read_text(file, "replace").rstrip().splitlines(), start=1):
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
    """Returns the matrix (4, 4) in a text file; NaN and infinities are read as such."""
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
    """Returns the pose of a matrix (4, 4) or (3, 4), whose rotation may be off by rounding; errors
    start with `source`."""
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


def outlier_frames(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns the indices of positions (N, 3) that are invalid, far from all others.

    Those are farther from the median position than 10 m and 20 times what four in five are.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return np.flatnonzero(distance > max(10.0, 20 * np.quantile(distance, 0.8)))


_MAX_DROPPED = 0.2
"""The fraction of frames that may be left out."""
_MAPS = 8
"""Cameras whose resampling is kept at a time."""
_VALID = 0.999
"""Fraction of a resampled pixel that must come from valid ones."""
_SAME_SHAPE = 0.02
"""Relative difference of aspect ratios below which depth shows the same view."""


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame of a capture, not yet inspected."""

    image: Path
    X_FB: Callable[[], RigidTransform]
    """Returns the pose as the file gives it, or raises ValueError that names the file: that of a
    body B, the camera with the file's axes, in the file's world F."""
    depth: Path | None = None
    lens: Lens | None = None
    """The camera of this frame; None takes that of the capture."""
    mask: Path | None = None
    """An image that is black where this one is not to be used."""
    name: str = ""
    """Path of the image as the files give it; empty for the name of the file."""
    held_out: bool = False
    """Whether the files hold this frame out from training."""


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
    lens: Callable[[int, int], Lens] | None = None,
    intrinsics: Sequence[float] = (),
    read_depth: Callable[[Path], NDArray[np.float32]] | None = None,
    depth_camera: Callable[[int, int], DepthCamera] | None = None,
    stretch_depth: bool = False,
    dropped: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Capture:
    """Opens frames, whose images and depths are read on demand.

    Args:
        path: the capture's folder or file.
        source: the format's name in `Capture.source`.
        axes: the axes of the files' poses.
        lens: returns the camera of images of a width and height [px], for frames without their own.
        intrinsics: fx, fy, cx, cy [px] that replace those of `lens`; or empty.
        read_depth: reads the depth [m] in a file; None if there is none.
        depth_camera: returns the camera of depth images of a width and height [px]; None if depth
            has the pixels of the images before they are undistorted.
        stretch_depth: whether depth, without a camera of its own, may have another resolution than
            the image.
        dropped: messages about frames that were left out already, which do not count further.
        notes: the first of `Capture.notes`.

    Raises:
        ValueError: if fewer than two frames, or less than four fifths of them, can be used.
    """
    messages = list(dropped)
    valid = _usable_frames(frames, messages, not (depth_camera or stretch_depth), stretch_depth)
    if valid:
        outliers = set(outlier_frames(np.array([f.X_FB.translation() for f in valid])).tolist())
        for i in sorted(outliers):
            p = valid[i].X_FB.translation().round(1)
            messages.append(f"{valid[i].files.image}: its position {p} is far from all others")
        valid = [frame for i, frame in enumerate(valid) if i not in outliers]
    if len(valid) < max(2, (1 - _MAX_DROPPED) * len(frames)):
        first = f"; the first that cannot: {messages[0]}" if messages else ""
        raise ValueError(
            f"{path}: {len(valid)} of {len(frames)} frames can be used, at least 2 and "
            f"{1 - _MAX_DROPPED:.0%} must be{first}"
        )

    def shared_lens() -> Lens:
        width, height = next(frame.size for frame in valid if frame.files.lens is None)
        if intrinsics:
            return Lens(pinhole(*intrinsics), width, height, source="capture.intrinsics")
        if lens is None:
            raise ValueError("unknown intrinsics; set capture.intrinsics to [fx, fy, cx, cy]")
        return lens(width, height)

    try:
        shared = shared_lens() if any(frame.files.lens is None for frame in valid) else None
        lenses = [frame.files.lens or shared for frame in valid]
        distinct = [each for each in dict.fromkeys(lenses) if each is not None]
        camera = common_pinhole(distinct)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # Some cameras focus every frame again: the maps of all would fill the memory.
    cached_maps = lru_cache(_MAPS)(lambda lens: resampling_maps(lens, camera))
    has_depth = read_depth is not None and any(frame.files.depth for frame in valid)

    def load_image(i: int) -> NDArray[np.uint8]:
        file = valid[i].files.image
        return resample(_require_size(read_image(file), file, valid[i].size), i, cv2.INTER_LINEAR)

    def load_valid(i: int) -> NDArray[np.bool_]:
        files, size = valid[i].files, valid[i].size
        mask = np.ones(size[::-1], dtype=bool)
        if files.mask is not None:
            mask &= _require_size(read_mask(files.mask), files.mask, size)
        if valid[i].has_alpha:
            mask &= _require_size(read_alpha(files.image), files.image, size)
        # A pixel interpolated from an invalid one is invalid.
        return resample(mask.astype(np.float32), i, cv2.INTER_LINEAR) > _VALID

    def load_depth(i: int) -> NDArray[np.float32] | None:
        file, size = valid[i].files.depth, valid[i].depth_size
        if file is None or size is None or read_depth is None:
            return None
        depth = _require_size(read_depth(file), file, size)
        if depth_camera:
            return depth
        # An average between two surfaces would lie on neither.
        if size != valid[i].size:
            depth = cv2.resize(depth, valid[i].size, interpolation=cv2.INTER_NEAREST_EXACT)
        return resample(depth, i, cv2.INTER_NEAREST)

    def resample(image: NDArray, i: int, interpolation: int) -> NDArray:
        lens = lenses[i]
        if lens is None or (maps := cached_maps(lens)) is None:
            return image
        # The pinhole sees up to half a pixel more than the lens, which is not black.
        return cv2.remap(image, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE)

    R_WF, R_BC = RigidTransform(axes.R_WF), RigidTransform(axes.R_BC)
    depth_sizes = [frame.depth_size for frame in valid if frame.depth_size]
    held_out = [i for i, frame in enumerate(valid) if frame.files.held_out]
    masked = sum(frame.files.mask is not None for frame in valid)
    transparent = sum(frame.has_alpha for frame in valid)
    return Capture(
        name=path.resolve().name,
        source=f"{source} {path.resolve()}",
        K=camera.K,
        width=camera.width,
        height=camera.height,
        X_WCs=[R_WF @ frame.X_FB @ R_BC for frame in valid],
        load_image=load_image,
        load_depth=load_depth if has_depth else no_depth,
        load_valid=load_valid if masked or transparent else all_valid,
        depth_camera=depth_camera(*depth_sizes[0]) if depth_camera and has_depth else None,
        frame_names=[frame.files.name or frame.files.image.name for frame in valid],
        dropped=messages,
        held_out=held_out if any(frame.held_out for frame in frames) else None,
        notes=[*notes, *_notes(distinct, masked, transparent, len(valid))],
        axes=axes,
    )


def _notes(lenses: Sequence[Lens], masked: int, transparent: int, total: int) -> list[str]:
    """Returns notes on the intrinsics and on the pixels that are not used."""
    notes = [f"intrinsics: {lenses[0]}"]
    if len(lenses) > 1:
        notes[0] += f", and {len(lenses) - 1} more cameras"
    if eccentric := [lens for lens in lenses if lens.is_eccentric]:
        cx, cy = eccentric[0].K[:2, 2].round(1).tolist()
        notes.append(
            f"the principal point ({cx}, {cy}) px is far from the center of the images; are "
            "intrinsics those of images of this size?"
        )
    if masked:
        notes.append(f"{masked} of {total} images have a mask; black pixels are not used")
    if transparent:
        notes.append(
            f"{transparent} of {total} images have an alpha channel; pixels of less than a half "
            "are not used"
        )
    return notes


def _usable_frames(
    frames: Sequence[FrameFiles], messages: list[str], registered: bool, same_view: bool
) -> list[_Frame]:
    """Returns the frames whose files are complete, in the most frequent sizes of images and depth.

    Args:
        messages: to which those about other frames are appended.
        registered: whether depth must have the size of its image.
        same_view: whether it must have the aspect ratio of its image.
    """
    complete = []
    for frame in frames:
        try:
            complete.append(_inspect(frame))
        except (ValueError, OSError) as error:
            messages.append(str(error))
    sizes = [frame.size for frame in complete if frame.files.lens is None]
    usual = max(sizes, key=sizes.count, default=None)
    depth_sizes = [frame.depth_size for frame in complete if frame.depth_size]
    usual_depth = max(depth_sizes, key=depth_sizes.count, default=None)
    kept = []
    for frame in complete:
        files, expected = frame.files, frame.size if registered else usual_depth
        (width, height), (w, h) = frame.size, frame.depth_size or frame.size
        if files.lens is None and usual is not None and frame.size != usual:
            messages.append(_size_message(files.image, frame.size, usual))
        elif files.depth and frame.depth_size and expected and frame.depth_size != expected:
            messages.append(_size_message(files.depth, frame.depth_size, expected))
        elif same_view and abs(w * height - h * width) > _SAME_SHAPE * w * height:
            messages.append(
                f"{files.depth}: {w}x{h} pixels of depth do not show what {width}x{height} pixels "
                "of an image do; width and height must have one ratio"
            )
        else:
            kept.append(frame)
    return kept


def _inspect(frame: FrameFiles) -> _Frame:
    size, mode = _image_header(frame.image)
    if frame.lens is not None and size != (frame.lens.width, frame.lens.height):
        raise ValueError(_size_message(frame.image, size, (frame.lens.width, frame.lens.height)))
    if frame.mask is not None and (found := image_size(frame.mask)) != size:
        raise ValueError(_size_message(frame.mask, found, size))
    found = depth_size(frame.depth) if frame.depth is not None else None
    return _Frame(frame, size, found, mode in _ALPHA, frame.X_FB())


def _size_message(file: Path, size: tuple[int, int], expected: tuple[int, int]) -> str:
    return (
        f"{file}: must be of {expected[0]}x{expected[1]} pixels, as the others, got "
        f"{size[0]}x{size[1]}"
    )


def _require_size(array: NDArray, file: Path, size: tuple[int, int]) -> NDArray:
    if array.shape[1::-1] != size:
        raise ValueError(_size_message(file, array.shape[1::-1], size))
    return array
