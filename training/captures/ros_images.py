"""Images of ROS messages, as files: raw and compressed, of colours and of depth."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

COLORS = {"rgb8": -1, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB}
COLORS |= {"bgra8": cv2.COLOR_BGRA2RGB, "mono8": cv2.COLOR_GRAY2RGB}
DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
DEPTH_UNIT = 1000.0
"""Units a metre of the depth that is written."""


def write_color(message: Any, file: Path) -> Path:
    """Writes the colours of an `Image` or `CompressedImage` to `file` with the extension of its
    kind, which it returns.

    Raises:
        KeyError, ValueError: for an encoding that is not known, or pixels that do not fit.
        OSError: if it cannot be written.
    """
    if hasattr(message, "format"):
        file = file.parent / f"{file.name}.{'png' if 'png' in message.format else 'jpg'}"
        file.write_bytes(bytes(message.data))
        return file
    pixels = _pixels(message, np.uint8)
    if (code := COLORS[message.encoding]) >= 0:
        pixels = cv2.cvtColor(pixels, code)
    return _write_png(file, pixels[..., ::-1])


def write_depth(message: Any, file: Path) -> Path:
    """Writes planar depth as `write_color` does colours: a PNG of 16 bits, in units of a
    millimetre, 0 where none is known."""
    if hasattr(message, "format"):
        # A header of an enumeration and two floats, then a PNG; of floats 1 / depth is stored.
        _, a, b = struct.unpack("<iff", bytes(message.data[:12]))
        stored = cv2.imdecode(np.asarray(message.data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
        if stored is None:
            raise ValueError("no PNG")
        depth = stored
        if "32FC1" in message.format:
            inverse = stored.astype(np.float32) - np.float32(b)
            depth = np.where(stored > 0, np.float32(a) / np.maximum(inverse, 1e-6), 0)
    else:
        depth = _pixels(message, DEPTHS[message.encoding])[..., 0]
    if depth.dtype != np.uint16:
        known = np.isfinite(depth) & (depth > 0) & (depth < 65.5)
        units = np.where(known, np.round(DEPTH_UNIT * np.where(known, depth, 0)), 0)
        depth = units.astype(np.uint16)
    return _write_png(file, depth)


def _pixels(message: Any, dtype: type) -> NDArray:
    """(H, W, C), of rows that may be padded."""
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    item = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    channels = rows.shape[1] // message.width // item.itemsize
    rows = np.ascontiguousarray(rows[:, : message.width * channels * item.itemsize])
    return rows.view(item).reshape(message.height, message.width, channels).astype(dtype)


def _write_png(file: Path, pixels: NDArray) -> Path:
    file = file.parent / f"{file.name}.png"
    if not cv2.imwrite(str(file), np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"{file}: cannot be written; is the disk full?")
    return file
