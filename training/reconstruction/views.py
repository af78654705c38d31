"""The images that a reconstruction is compared with, shrunk and ready."""

from collections.abc import Sequence
from functools import cache
from typing import overload

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from torch import Tensor

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.background import (
    BLACK,
    FAR,
    Background,
    EnvironmentMap,
    pixel_rays,
    texel_position,
)
from splatpilot.training.captures.capture import Capture, CaptureFrame, shrink
from splatpilot.training.reconstruction.losses import depth_edge_weights
from splatpilot.training.reconstruction.photometry import Photometry

# [bytes], of colour, depth and validity together, and what the frames of a capture may take.
_PIXEL_SIZE, _MEMORY = 8, 1e9


class ShrunkFrames(Sequence[CaptureFrame]):
    """Some frames of a capture, shrunk by a whole factor, each loaded when asked for.

    They are kept from then on, unless all of them would take more than 1 GB.

    Args:
        capture: what was seen.
        numbers: the frames to take.
        factor: see `shrink`.
    """

    def __init__(self, capture: Capture, numbers: Sequence[int], factor: int):
        self._capture, self.numbers, self.factor = capture, list(numbers), factor
        pixels = len(self.numbers) * (capture.width // factor) * (capture.height // factor)
        small = pixels * _PIXEL_SIZE <= _MEMORY
        self._load = cache(self._load_and_shrink) if small else self._load_and_shrink

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, k: int) -> CaptureFrame: ...
    @overload
    def __getitem__(self, k: slice) -> "ShrunkFrames": ...
    def __getitem__(self, k):
        if isinstance(k, slice):
            return ShrunkFrames(self._capture, self.numbers[k], self.factor)
        return self._load(range(len(self))[k])

    def _load_and_shrink(self, k: int) -> CaptureFrame:
        return shrink(self._capture.frame(self.numbers[k]), self.factor)


class ReconstructionViews:
    """Frames as tensors on the CPU.

    Args:
        frames: all of one size and with one K.
        photometry: their gains, in their order, and their vignetting.
    """

    def __init__(self, frames: Sequence[CaptureFrame], photometry: Photometry):
        images, depths, edges, valid, viewmats = [], [], [], [], []
        for frame in Progress(frames, "loading frames", len(frames), unit="frame"):
            images.append(torch.from_numpy(frame.image))
            depths.append(torch.from_numpy(frame.depth))
            edges.append(depth_edge_weights(depths[-1]).half())
            valid.append(torch.from_numpy(frame.valid.copy()))
            viewmats.append(torch.from_numpy(frame.X_WC.inverse().GetAsMatrix4()).float())
        self.images = torch.stack(images)  # (n, H, W, 3) uint8
        self.depths = torch.stack(depths)  # (n, H, W) [m]
        self.edges = torch.stack(edges)  # (n, H, W) weights of the depth term
        self.valid = torch.stack(valid)  # (n, H, W) pixels that are used
        self.viewmats = torch.stack(viewmats)  # (n, 4, 4) X_CW
        self.K = torch.from_numpy(frames[0].K).float()[None]  # (1, 3, 3) [px]
        self.height, self.width = self.depths.shape[1:]
        self.vignetting = photometry.vignetting
        self.gains = torch.from_numpy(photometry.gains).float()  # (n,)
        vignette = photometry.factor(0, self.height, self.width) / photometry.gains[0]
        self.vignette = torch.from_numpy(vignette).float()  # (H, W)

    def __len__(self) -> int:
        return len(self.images)

    def camera(self, k: int, device: str) -> tuple[Tensor, Tensor]:
        """Returns X_CW (1, 4, 4) and K (1, 3, 3) [px] of view k on a device."""
        return self.viewmats[k : k + 1].to(device), self.K.to(device)

    def extent(self) -> tuple[NDArray[np.float64], float]:
        """Returns the mean position (3,) [m] of the cameras and 1.1 times the largest distance from
        it [m], by which learning rates and sizes are scaled; 1 m if all stand in one place."""
        X_CWs = self.viewmats.double().numpy()
        p_WCs = -np.einsum("nji,nj->ni", X_CWs[:, :3, :3], X_CWs[:, :3, 3])
        center = p_WCs.mean(axis=0)
        extent = 1.1 * float(np.linalg.norm(p_WCs - center, axis=1).max())
        return center, extent if extent > 1e-6 else 1.0

    def frame(self, k: int) -> CaptureFrame:
        """Returns a frame as it was given."""
        X_WC = RigidTransform(self.viewmats[k].double().numpy()).inverse()
        K = self.K[0].double().numpy()
        arrays = (self.images[k].numpy(), self.depths[k].numpy())
        return CaptureFrame(*arrays, X_WC, K, self.valid[k].numpy())

    def target(self, k: int, gain: Tensor, backdrop: Tensor) -> Tensor:
        """(H, W, 3), what the scene should look like before a `backdrop` (3,): the image freed of
        its gain and vignetting, about 0 to 1, and nothing where it shows the infinitely far."""
        color = self.images[k].float().mul_((1 / (255 * gain * self.vignette))[..., None])
        color[self.depths[k] >= FAR] = backdrop
        return color


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
        row, column = texel_position(
            pixel_rays(frame.K, rows, columns, frame.X_WC), _HEIGHT, _WIDTH
        )
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
