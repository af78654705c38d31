"""Frames made smaller."""

import cv2
import numpy as np
from numpy.typing import NDArray

from splatpilot.training.captures.capture import CaptureFrame

# Depths within a pixel that differ by more than this fraction belong to different surfaces.
_ONE_SURFACE = 0.1


def shrink_factor(width: int, wanted: int) -> int:
    """Returns by which whole factor to shrink images of `width` [px] to about `wanted`, 0: 1."""
    return max(1, round(width / wanted)) if wanted else 1


def shrink_mask(valid: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Returns which pixels of a shrunken image replace valid ones alone."""
    return _blocks(valid, factor).all(axis=-1)


def _blocks(pixels: NDArray, factor: int) -> NDArray:
    """(h, w, factor^2) from (H, W): what each shrunken pixel replaces."""
    height, width = (n // factor for n in pixels.shape)
    blocks = pixels[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return blocks.swapaxes(1, 2).reshape(height, width, factor**2)


def shrink(frame: CaptureFrame, factor: int) -> CaptureFrame:
    """Returns the frame with each factor x factor pixels made one; what remains at the right and at
    the bottom is cut off.

    Colours are averaged. Depth is averaged as its inverse, which is exact on planes, where it is of
    one surface; at the edges of things it is the (lower) median, a depth that was seen. It is
    unknown (0) where most of it is, and infinite where it is beyond range. A pixel is valid if all
    that it replaces are.
    """
    if factor == 1:
        return frame
    height, width = (n // factor for n in frame.depth.shape)
    image = frame.image[: height * factor, : width * factor]
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    blocks, valid = _blocks(frame.depth, factor), shrink_mask(frame.valid, factor)
    known = blocks > 0
    count = known.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(known, 1 / blocks, 0)
        most = inverse.max(axis=-1)
        spread = most - np.where(known, inverse, np.inf).min(axis=-1)
        mean = count / inverse.sum(axis=-1)
        # Sorted, the unknown ones come last.
        ordered = np.sort(np.where(known, blocks, np.nan), axis=-1)
        middle = np.maximum(count - 1, 0)[..., None] // 2
        median = np.take_along_axis(ordered, middle, axis=-1)[..., 0]
        depth = np.where(spread <= _ONE_SURFACE * most, mean, median)
    depth = np.where((2 * count > factor**2) & valid, depth, 0).astype(np.float32)
    K = frame.K.copy()
    K[:2] /= factor
    return CaptureFrame(np.asarray(image, dtype=np.uint8), depth, frame.X_WC, K, valid)
