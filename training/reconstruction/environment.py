"""What lies infinitely far, learned from the pixels that show it."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.splats.background import (
    BLACK,
    FAR,
    Background,
    EnvironmentMap,
    pixel_rays,
    texel_of,
)
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.photometry import Photometry

_HEIGHT, _WIDTH = 128, 256  # texels, powers of two


def learn_background(frames: Sequence[CaptureFrame], photometry: Photometry) -> Background:
    """Returns what the frames show infinitely far away, in every direction; black if they show
    nothing there.

    Each texel has the mean colour, freed of gains and vignetting, of the pixels that look into it;
    where none does, it is interpolated between its neighbours.

    Args:
        frames: with true depth; loaded one by one.
        photometry: their brightness, in their order.
    """
    sums, counts = np.zeros((_HEIGHT * _WIDTH, 3)), np.zeros(_HEIGHT * _WIDTH)
    for k, frame in enumerate(frames):
        far = frame.depth >= FAR
        if not far.any():
            continue
        rows, columns = np.nonzero(far)
        factor = photometry.factor(k, *far.shape)
        color = frame.image[far] / (255 * factor[far])[:, None]
        row, column = texel_of(pixel_rays(frame.K, rows, columns, frame.X_WC), _HEIGHT, _WIDTH)
        row, column = np.minimum(row.astype(int), _HEIGHT - 1), column.astype(int) % _WIDTH
        np.add.at(sums, row * _WIDTH + column, color)
        np.add.at(counts, row * _WIDTH + column, 1)
    if not counts.any():
        return BLACK
    texels = _fill(sums.reshape(_HEIGHT, _WIDTH, 3), counts.reshape(_HEIGHT, _WIDTH))
    return EnvironmentMap(texels.clip(0, 1).astype(np.float32))


def _fill(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the means (h, w, 3) of texels, those without any interpolated from means of four."""
    means = sums / np.maximum(counts, 1)[..., None]
    if counts.all():
        return means
    height, width = counts.shape
    block = (max(height // 2, 1), min(height, 2), width // 2, 2)
    coarse = _fill(sums.reshape(*block, 3).sum(axis=(1, 3)), counts.reshape(block).sum(axis=(1, 3)))
    # One more column on either side, from the other end: azimuth goes round.
    around = np.pad(coarse, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    around = cv2.resize(around, (width + 4, height), interpolation=cv2.INTER_LINEAR)
    return np.where(counts[..., None] > 0, means, around[:, 2:-2])
