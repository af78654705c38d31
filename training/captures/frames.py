"""From lists of files and poses to a `Capture`; every format that keeps frames in files ends here.

What is wrong with single frames leaves those out, with a message each in `Capture.dropped`: files
that are missing, empty, unreadable or of another size, poses that are not finite, no rotation or
far from all others. It is an error if more than a fifth of the frames are left out, because then it
is the capture that is read wrongly.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.readers import (
    array_layout,
    read_array,
    read_text,
    reason_of,
    require_readable_size,
)
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


def exr_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] without reading the pixels.

    Raises:
        ValueError: if it is no EXR file.
        ModuleNotFoundError: if the extra `exr` is not installed.
    """
    (left, top), (right, bottom) = _open(file, header_only=True).header()["dataWindow"]
    return int(right - left + 1), int(bottom - top + 1)


def read_exr(file: Path) -> NDArray[np.float32]:
    """Returns the pixels (H, W) of a file of one channel, or of its first if it has several.

    Raises:
        ValueError: if it is no EXR file.
        ModuleNotFoundError: if the extra `exr` is not installed.
    """
    channels = _open(file, separate_channels=True).channels()
    return np.asarray(next(iter(channels.values())).pixels, dtype=np.float32)


def _open(file: Path, **options: bool) -> Any:
    OpenEXR: Any = import_extra("OpenEXR", "exr")
    try:
        return OpenEXR.File(str(file), **options)
    except Exception as error:  # OpenEXR raises anything of damaged files
        raise ValueError(f"{file}: not a readable EXR file ({error}); copy it again") from None


IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}

_DEPTH_IS = "depth is one number a pixel, of integers of more than 8 bits or floats"
# Pillow's modes of images without depth; four channels may be the bytes of one number.
_NO_DEPTH = {"1", "L", "P", "LA", "PA", "RGB", "CMYK", "YCbCr"}
_ALPHA = {"RGBA", "LA", "PA"}
_ENDS = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}


def image_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] of an image without decoding it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, no image or cut short.
    """
    return _image_header(file)[0]


def image_layout(file: Path) -> tuple[tuple[int, int], bool]:
    """Returns what `image_size` does, and whether the image has an alpha channel."""
    size, mode = _image_header(file)
    return size, mode in _ALPHA


def _image_header(file: Path) -> tuple[tuple[int, int], str]:
    """Its size, and Pillow's name for what its pixels are."""
    _require_content(file)
    try:
        with Image.open(file) as image:
            size, kind, mode = image.size, image.format, image.mode
            if "transparency" in image.info:  # of one color, or of those of a palette
                mode = "RGBA"
    except Exception as error:  # Pillow raises anything of damaged files
        raise ValueError(
            f"{file}: not a readable image ({_reason(error)}); copy it again"
        ) from None
    require_readable_size(file, 4 * size[0] * size[1])
    with file.open("rb") as stream:
        # Cameras append previews and padding to JPEGs, so the end is looked for, not asked for.
        stream.seek(max(0, file.stat().st_size - 65536))
        if _ENDS.get(kind or "", b"") not in stream.read():
            raise ValueError(f"{file}: not a readable image (it is cut short); copy it again")
    return size, mode


def array_shape(file: Path) -> tuple[int, ...]:
    """Returns the shape of an array in a `.npy` file without reading it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, no array or cut short.
    """
    return _depth_layout(file)[0]


def _depth_layout(file: Path) -> tuple[tuple[int, ...], np.dtype]:
    _require_content(file)
    shape, dtype = array_layout(file)
    if dtype.kind not in "iuf" or dtype.itemsize == 1:
        raise ValueError(f"{file}: an array of {dtype}; {_DEPTH_IS}")
    return shape, dtype


def depth_size(file: Path) -> tuple[int, int]:
    """Returns width and height [px] of a depth image or array; raises as the two above."""
    if file.suffix == ".exr":
        _require_content(file)
        return exr_size(file)
    if file.suffix != ".npy":
        size, mode = _image_header(file)
        if mode in _NO_DEPTH:
            raise ValueError(f"{file}: pixels of 8 bits or several channels; {_DEPTH_IS}")
        return size
    shape = array_shape(file)
    if len(shape) != 2:
        raise ValueError(f"{file}: an array of shape {shape}; depth has rows and columns alone")
    return shape[1], shape[0]


def read_image(file: Path) -> NDArray[np.uint8]:
    """Returns an image as (H, W, 3) red, green, blue; raises ValueError if it is unreadable."""
    # The pixels as they are stored: poses and intrinsics belong to them, not to the turned picture.
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
    """Returns where a mask (H, W) is not black; raises ValueError if it is unreadable."""
    return _decode(file, cv2.IMREAD_ANYDEPTH) > 0


def read_depth(file: Path, unit: float) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from `.npy`, `.exr`, or an image of integers or floats.

    Args:
        unit: how many units of the file make a metre.

    What is no number or not in front of the camera, and the largest 16-bit number, which sensors
    write where they see nothing, become 0, unknown.
    """
    if file.suffix == ".npy":
        _depth_layout(file)
        raw = read_array(file)
    elif file.suffix == ".exr":
        raw = read_exr(file)
    else:
        raw = _decode(file, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype == np.uint8:
        raise ValueError(f"{file}: a {raw.dtype} array of shape {raw.shape}; {_DEPTH_IS}")
    depth = raw.astype(np.float32) / np.float32(unit)
    if raw.dtype == np.uint16:
        depth[raw == 65535] = 0
    return _clean(depth)


def read_packed_depth(file: Path) -> NDArray[np.float32]:
    """Returns depth (H, W) [m] from a PNG whose four channels hold the bytes of a float32."""
    raw = _decode(file, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 3 or raw.shape[2] != 4 or raw.dtype != np.uint8:
        raise ValueError(
            f"{file}: a {raw.dtype} array of shape {raw.shape}; four channels of 8 bits, the bytes "
            "of 32-bit depth, are needed"
        )
    return _clean(np.ascontiguousarray(raw).view("<f4")[..., 0].copy())


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Returns the files of `folder` by the number in their name, in its order.

    Args:
        pattern: regular expression of the whole name, whose group is the number.

    Raises:
        FileNotFoundError: if there is no such folder, or no name is like that.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: the folder is missing")
    files = {}
    for file in folder.iterdir():
        if match := re.fullmatch(pattern, file.name):
            files[int(match[1])] = file
    if not files:
        raise FileNotFoundError(f"{folder}: holds no file named like {pattern}")
    return dict(sorted(files.items()))


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


def _require_content(file: Path) -> None:
    try:
        there = file.is_file()
    except OSError as error:  # its name is too long, or that of a folder
        raise ValueError(
            f"{str(file)[:200]}...: {error.strerror}; correct the name where it is listed"
        ) from None
    if not there:
        raise FileNotFoundError(f"{file}: the file is missing")
    if file.stat().st_size == 0:
        raise ValueError(f"{file}: the file is empty; copy it again")


def _reason(error: Exception) -> str:
    return reason_of(error).partition(" '")[0]


_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_LARGEST = 1e8
"""[m], beyond which a position is not on Earth, whatever its origin."""


def read_rows(file: Path, columns: int, what: str) -> list[NDArray[np.float64]]:
    """Returns the rows of numbers of a text file, each (columns,); NaN is read as such.

    Lines that start with # and empty lines at the end are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a line does not hold `columns` numbers, which `what` describes.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{file}: the file is missing")
    rows = []
    for number, line in enumerate(read_text(file, "replace").rstrip().splitlines(), start=1):
        if line.startswith("#"):
            continue
        try:
            row = np.array(line.split(), dtype=np.float64)
        except ValueError:
            row = np.array([])
        if row.shape != (columns,):
            raise ValueError(f"{file}, line {number}: {line[:80]!r} is no {what}")
        rows.append(row)
    return rows


def read_matrix(file: Path) -> NDArray[np.float64]:
    """Returns the matrix (4, 4) in a text file; NaN and infinities are read as such.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it does not hold four rows of four numbers.
    """
    rows = read_rows(file, 4, "row of a 4x4 matrix; four numbers are needed")
    if len(rows) != 4:
        raise ValueError(f"{file}: {len(rows)} rows, 4 are needed")
    return np.array(rows)


def pose_from_quaternion(row: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a row tx ty tz qx qy qz qw.

    Raises:
        ValueError: if it is no pose; the message starts with `source`.
    """
    _require_finite(row, source)
    _require_position(row[:3], source)
    norm = np.linalg.norm(row[3:])
    if not abs(norm - 1) < 1e-3:
        raise ValueError(
            f"{source}: the quaternion has the length {norm:.6g}, 1 within 0.001 is needed; the "
            "order should be tx ty tz qx qy qz qw"
        )
    x, y, z, w = row[3:]
    return RigidTransform(Quaternion(np.array([w, x, y, z]) / norm), row[:3])


def pose_from_matrix(matrix: NDArray[np.float64], source: str) -> RigidTransform:
    """Returns the pose of a matrix (4, 4), or (3, 4) without its last row, whose rotation may be
    off by rounding.

    Raises:
        ValueError: if it is not a pose; the message starts with `source`.
    """
    _require_finite(matrix, source)
    if not np.allclose(matrix[3:], _LAST_ROW, atol=1e-6):
        columns = np.allclose(matrix[:, 3], _LAST_ROW, atol=1e-6)
        why = "the matrix is stored column by column; transpose it" if columns else "copy it again"
        raise ValueError(
            f"{source}: the last row of a pose must be 0 0 0 1, got {matrix[3].tolist()}: {why}"
        )
    R, p = matrix[:3, :3], matrix[:3, 3]
    _require_position(p, source)
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > 0.01 or np.linalg.det(R) < 0:
        raise ValueError(
            f"{source}: no rotation (R R^T is off by {error:.2g}, the determinant is "
            f"{np.linalg.det(R):.3g}); a rigid transform is needed"
        )
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


def _require_finite(pose: NDArray[np.float64], source: str) -> None:
    if not np.isfinite(pose).all():
        raise ValueError(f"{source}: the pose is not finite (tracking was lost?)")


def _require_position(p: NDArray[np.float64], source: str) -> None:
    if np.abs(p).max() > _LARGEST:
        raise ValueError(f"{source}: the position {p} is more than {_LARGEST:g} m away")


def stray_frames(positions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns the numbers of positions (N, 3) so far from the others that they must be mistakes.

    Those are farther from the median position than 20 times what four in five are, and than 10 m.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return np.flatnonzero(distance > max(10.0, 20 * np.quantile(distance, 0.8)))


MAX_DROPPED = 0.2
"""The fraction of frames that may be left out."""
_MAPS = 8
"""Cameras whose resampling is kept at a time."""
_WHOLE = 0.999
"""Part of a resampled pixel that must come from valid ones."""
_SAME_SHAPE = 0.02
"""Relative difference of the ratios of width to height, below which depth shows the same view."""


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame of a capture, not yet looked at."""

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
    """A frame whose files look whole."""

    files: FrameFiles
    size: tuple[int, int]  # width and height [px]
    depth_size: tuple[int, int] | None
    has_alpha: bool
    X_FB: RigidTransform


def open_frames(
    path: Path,
    kind: str,
    frames: Sequence[FrameFiles],
    *,
    axes: FileAxes,
    lens: Callable[[int, int], Lens] = lambda width, height: _no_lens(),
    intrinsics: Sequence[float] = (),
    read_depth: Callable[[Path], NDArray[np.float32]] | None = None,
    depth_camera: Callable[[int, int], DepthCamera] | None = None,
    stretch_depth: bool = False,
    dropped: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Capture:
    """Opens the frames; images and depths are read when asked for.

    Args:
        path: the capture's folder or file.
        kind: what it is called in `Capture.source`.
        axes: the axes of the files' poses.
        lens: gives the camera of images of a width and height [px], for frames that bring none.
        intrinsics: fx, fy, cx, cy [px] that replace those of `lens`; or empty.
        read_depth: reads the depth [m] in a file; None if there is none.
        depth_camera: gives the camera of depth images of a width and height [px]; None if depth has
            the pixels of the images before they are undistorted.
        stretch_depth: whether depth, without a camera of its own, may show in fewer pixels or more
            what the image shows.
        dropped: messages about frames that were left out already, which do not count further.
        notes: the first of `Capture.notes`.

    Raises:
        ValueError: if fewer than two frames, or less than four fifths of them, can be used.
    """
    messages = list(dropped)
    sound: list[_Frame] = []
    for frame in frames:
        try:
            sound.append(_inspect(frame))
        except (ValueError, OSError) as error:
            messages.append(str(error))
    sound = _keep_usual_size(sound, messages, registered=not (depth_camera or stretch_depth))
    if stretch_depth:
        sound = _keep_same_view(sound, messages)
    if sound:
        stray = set(stray_frames(np.array([frame.X_FB.translation() for frame in sound])).tolist())
        for i in sorted(stray):
            p = sound[i].X_FB.translation().round(1)
            messages.append(f"{sound[i].files.image}: its position {p} is far from all others")
        sound = [frame for i, frame in enumerate(sound) if i not in stray]
    if len(sound) < max(2, (1 - MAX_DROPPED) * len(frames)):
        first = f"; the first that cannot: {messages[0]}" if messages else ""
        raise ValueError(
            f"{path}: {len(sound)} of {len(frames)} frames can be used, at least 2 and "
            f"{1 - MAX_DROPPED:.0%} are needed{first}"
        )

    def shared_lens() -> Lens:
        width, height = next(frame.size for frame in sound if frame.files.lens is None)
        if intrinsics:
            return Lens(pinhole(*intrinsics), width, height, source="capture.intrinsics")
        return lens(width, height)

    try:
        shared = shared_lens() if any(frame.files.lens is None for frame in sound) else None
        lenses = [frame.files.lens or shared for frame in sound]
        distinct = [each for each in dict.fromkeys(lenses) if each is not None]
        camera = common_pinhole(distinct)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # Some cameras focus anew with each frame: their maps would fill the memory.
    map_of = lru_cache(_MAPS)(lambda lens: resampling_maps(lens, camera))
    has_depth = read_depth is not None and any(frame.files.depth for frame in sound)

    def load_image(i: int) -> NDArray[np.uint8]:
        file = sound[i].files.image
        return _resample(_require_size(read_image(file), file, sound[i].size), i, cv2.INTER_LINEAR)

    def load_valid(i: int) -> NDArray[np.bool_]:
        files, size = sound[i].files, sound[i].size
        valid = np.ones(size[::-1], dtype=bool)
        if files.mask is not None:
            valid &= _require_size(read_mask(files.mask), files.mask, size)
        if sound[i].has_alpha:
            valid &= _require_size(read_alpha(files.image), files.image, size)
        # No pixel is valid whose color is interpolated from one that is not.
        return _resample(valid.astype(np.float32), i, cv2.INTER_LINEAR) > _WHOLE

    def load_depth(i: int) -> NDArray[np.float32] | None:
        file, size = sound[i].files.depth, sound[i].depth_size
        if file is None or size is None or read_depth is None:
            return None
        depth = _require_size(read_depth(file), file, size)
        if depth_camera:
            return depth
        # Between surfaces an average would be a place where nothing is.
        if size != sound[i].size:
            depth = cv2.resize(depth, sound[i].size, interpolation=cv2.INTER_NEAREST_EXACT)
        return _resample(depth, i, cv2.INTER_NEAREST)

    def _resample(image: NDArray, i: int, interpolation: int) -> NDArray:
        lens = lenses[i]
        if lens is None or (found := map_of(lens)) is None:
            return image
        # The pinhole sees up to half a pixel more than the lens, which is not black.
        return cv2.remap(image, *found, interpolation, borderMode=cv2.BORDER_REPLICATE)

    R_WF, R_BC = RigidTransform(axes.R_WF), RigidTransform(axes.R_BC)
    depth_sizes = [frame.depth_size for frame in sound if frame.depth_size]
    held_out = [i for i, frame in enumerate(sound) if frame.files.held_out]
    masked = sum(frame.files.mask is not None for frame in sound)
    transparent = sum(frame.has_alpha for frame in sound)
    return Capture(
        name=path.resolve().name,
        source=f"{kind} {path.resolve()}",
        K=camera.K,
        width=camera.width,
        height=camera.height,
        X_WCs=[R_WF @ frame.X_FB @ R_BC for frame in sound],
        load_image=load_image,
        load_depth=load_depth if has_depth else no_depth,
        load_valid=load_valid if masked or transparent else all_valid,
        depth_camera=depth_camera(*depth_sizes[0]) if depth_camera and has_depth else None,
        frame_names=[frame.files.name or frame.files.image.name for frame in sound],
        dropped=messages,
        held_out=held_out if any(frame.held_out for frame in frames) else None,
        notes=[*notes, *_notes(distinct, masked, transparent, len(sound))],
        axes=axes,
    )


def _notes(lenses: Sequence[Lens], masked: int, transparent: int, total: int) -> list[str]:
    """Returns what is noted of every capture: its intrinsics, and which pixels are not used."""
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
        notes.append(f"{masked} of {total} images have a mask, and are not used where it is black")
    if transparent:
        notes.append(
            f"{transparent} of {total} images have an alpha channel, and are not used where it is "
            "less than a half"
        )
    return notes


def _no_lens() -> Lens:
    raise ValueError("the intrinsics are unknown; set capture.intrinsics to [fx, fy, cx, cy]")


def _inspect(frame: FrameFiles) -> _Frame:
    size, has_alpha = image_layout(frame.image)
    if frame.lens is not None and size != (frame.lens.width, frame.lens.height):
        raise ValueError(_size_message(frame.image, size, (frame.lens.width, frame.lens.height)))
    if frame.mask is not None and (found := image_size(frame.mask)) != size:
        raise ValueError(_size_message(frame.mask, found, size))
    found = depth_size(frame.depth) if frame.depth is not None else None
    return _Frame(frame, size, found, has_alpha, frame.X_FB())


def _keep_usual_size(
    frames: Sequence[_Frame], messages: list[str], registered: bool
) -> list[_Frame]:
    """Leaves out frames of another size than most, or whose depth is."""
    sizes = [frame.size for frame in frames if frame.files.lens is None]
    usual = max(sizes, key=sizes.count, default=None)
    depth_sizes = [frame.depth_size for frame in frames if frame.depth_size]
    usual_depth = max(depth_sizes, key=depth_sizes.count, default=None)
    kept = []
    for frame in frames:
        files, wanted = frame.files, frame.size if registered else usual_depth
        if files.lens is None and usual is not None and frame.size != usual:
            messages.append(_size_message(files.image, frame.size, usual))
        elif files.depth and frame.depth_size and wanted and frame.depth_size != wanted:
            messages.append(_size_message(files.depth, frame.depth_size, wanted))
        else:
            kept.append(frame)
    return kept


def _keep_same_view(frames: Sequence[_Frame], messages: list[str]) -> list[_Frame]:
    """Leaves out frames whose depth has another shape than their image."""
    kept = []
    for frame in frames:
        (width, height), (w, h) = frame.size, frame.depth_size or frame.size
        if abs(w * height - h * width) > _SAME_SHAPE * w * height:
            messages.append(
                f"{frame.files.depth}: {w}x{h} pixels of depth do not show what {width}x{height} "
                "pixels of an image do; width and height must have one ratio"
            )
        else:
            kept.append(frame)
    return kept


def _size_message(file: Path, size: tuple[int, int], wanted: tuple[int, int]) -> str:
    return (
        f"{file}: {size[0]}x{size[1]} pixels where {wanted[0]}x{wanted[1]} are expected; all "
        "images of a camera, and all depths, must have one size"
    )


def _require_size(array: NDArray, file: Path, size: tuple[int, int]) -> NDArray:
    if array.shape[1::-1] != size:
        raise ValueError(_size_message(file, array.shape[1::-1], size))
    return array
