"""Reading the images and depths of captures, and telling early which cannot be read."""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatpilot.systems.array_files import array_layout, read_array, reason_of
from splatpilot.systems.png_chunks import require_whole_chunks
from splatpilot.systems.read_limit import require_readable_size
from splatpilot.training.captures.exr_files import exr_size, read_exr

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
    content = file.read_bytes()
    require_whole_chunks(file, content)
    raw = np.frombuffer(content, np.uint8)
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
