"""Frames of a capture for reconstruction, shrunk and as tensors, and the learned background."""

import hashlib
from collections.abc import Sequence
from functools import cache

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

_PIXEL_SIZE, _MEMORY = 8, 1e9  # [bytes], of a pixel with depth and validity; of cached frames
_HEIGHT, _WIDTH = 128, 256  # texels of the background, powers of two


class ShrunkFrames(Sequence[CaptureFrame]):
    """The frames `numbers` of a capture, shrunk by an integer `factor`, loaded on first use and
    kept if all of them take at most 1 GB."""

    def __init__(self, capture: Capture, numbers: Sequence[int], factor: int):
        self._capture, self.numbers, self.factor = capture, list(numbers), factor
        pixels = len(self.numbers) * (capture.width // factor) * (capture.height // factor)
        small = pixels * _PIXEL_SIZE <= _MEMORY
        self._load = cache(self._load_and_shrink) if small else self._load_and_shrink

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, k: int) -> CaptureFrame:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._load(range(len(self))[k])

    def _load_and_shrink(self, k: int) -> CaptureFrame:
        return shrink(self._capture.frame(self.numbers[k]), self.factor)


class ReconstructionViews:
    """Frames of one size and K, with their photometry, as tensors on the CPU."""

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

    def digest(self) -> str:
        """Returns a digest of images, depths and cameras."""
        tensors = (self.images, self.depths, self.valid, self.viewmats, self.K, self.gains)
        digest = hashlib.sha256()
        for tensor in tensors:
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()

    def camera(self, k: int, device: str) -> tuple[Tensor, Tensor]:
        """Returns X_CW (1, 4, 4) and K (1, 3, 3) [px] of view k on a device."""
        return self.viewmats[k : k + 1].to(device), self.K.to(device)

    def extent(self) -> tuple[NDArray[np.float64], float]:
        """Returns the mean position (3,) [m] of the cameras and 1.1 times the largest distance from
        it [m], which scales learning rates and sizes; 1 m if all cameras coincide."""
        X_CWs = self.viewmats.double().numpy()
        p_WCs = -np.einsum("nji,nj->ni", X_CWs[:, :3, :3], X_CWs[:, :3, 3])
        center = p_WCs.mean(axis=0)
        extent = 1.1 * float(np.linalg.norm(p_WCs - center, axis=1).max())
        return center, extent if extent > 1e-6 else 1.0

    def frame(self, k: int) -> CaptureFrame:
        """Returns a frame as given."""
        X_WC = RigidTransform(self.viewmats[k].double().numpy()).inverse()
        K = self.K[0].double().numpy()
        arrays = (self.images[k].numpy(), self.depths[k].numpy())
        return CaptureFrame(*arrays, X_WC, K, self.valid[k].numpy())

    def target(self, k: int, gain: Tensor, background: Tensor) -> Tensor:
        """Returns the image (H, W, 3) without gain and vignetting, about 0 to 1, with `background`
        (3,) in the sky."""
        color = self.images[k].float().mul_((1 / (255 * gain * self.vignette))[..., None])
        color[self.depths[k] >= FAR] = background
        return color


def learn_background(frames: Sequence[CaptureFrame], photometry: Photometry) -> Background:
    """Learns the sky of the frames in every direction; black without any. Each texel has the mean
    color, without gains and vignetting, of the pixels that look into it, or else is
    interpolated."""
    sums, counts = np.zeros((_HEIGHT * _WIDTH, 3)), np.zeros(_HEIGHT * _WIDTH)
    for k, frame in enumerate(frames):
        sky = frame.depth >= FAR
        if not sky.any():
            continue
        rows, columns = np.nonzero(sky)
        factor = photometry.factor(k, *sky.shape)
        color = frame.image[sky] / (255 * factor[sky])[:, None]
        v_W = pixel_rays(frame.K, rows, columns, frame.X_WC)
        row, column = texel_position(v_W, _HEIGHT, _WIDTH)
        row, column = np.minimum(row.astype(int), _HEIGHT - 1), column.astype(int) % _WIDTH
        np.add.at(sums, row * _WIDTH + column, color)
        np.add.at(counts, row * _WIDTH + column, 1)
    if not counts.any():
        return BLACK
    texels = _fill(sums.reshape(_HEIGHT, _WIDTH, 3), counts.reshape(_HEIGHT, _WIDTH))
    return EnvironmentMap(texels.clip(0, 1).astype(np.float32))


def _fill(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the means (h, w, 3) of texels; empty ones are interpolated from means of four."""
    means = sums / np.maximum(counts, 1)[..., None]
    if counts.all():
        return means
    height, width = counts.shape
    block = (max(height // 2, 1), min(height, 2), width // 2, 2)
    coarse = _fill(sums.reshape(*block, 3).sum(axis=(1, 3)), counts.reshape(block).sum(axis=(1, 3)))
    # One more column on either side, because azimuth is periodic.
    around = np.pad(coarse, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    around = cv2.resize(around, (width + 4, height), interpolation=cv2.INTER_LINEAR)
    return np.where(counts[..., None] > 0, means, around[:, 2:-2])
