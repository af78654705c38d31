"""Frames of a capture for reconstruction, shrunk and as tensors, and the learned background."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.background import (
    FAR,
    Background,
    EnvironmentMap,
    pixel_rays,
    texel_position,
)
from splatpilot.training.captures.capture import Capture, CaptureFrame, shrink
from splatpilot.training.reconstruction.losses import depth_edge_weights
from splatpilot.training.reconstruction.photometry import Photometry

_MIN_DEPTH = 1e-3  # [m], of cached frames
_CODES = 65535  # of cached depth: 0 is unknown, the last is FAR, equal ratios are between others
_OUTLINES = 4  # share of a view's steps that fit outlines, relative to that of sky in it
_SPARSE = 4  # one in so many pixels along each axis gives the mean color and the median depth
_HEIGHT, _WIDTH = 128, 256  # texels of the background, powers of two
_DEPTHS = np.geomspace(_MIN_DEPTH, FAR, _CODES).astype(np.float32)
_DEPTHS = np.concatenate([[0], _DEPTHS[:-1], [np.inf]], dtype=np.float32)


class ShrunkFrames(Sequence[CaptureFrame]):
    """The frames `numbers` of a capture, shrunk by an integer `factor`, loaded on first use and
    kept in 5 bytes a pixel. Depth is rounded by at most 1e-4 of it."""

    def __init__(self, capture: Capture, numbers: Sequence[int], factor: int):
        self._capture, self.numbers, self.factor = capture, list(numbers), factor
        self._kept: dict[int, tuple[CaptureFrame, NDArray[np.uint16]]] = {}

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, k: int) -> CaptureFrame:  # pyright: ignore[reportIncompatibleMethodOverride]
        k = range(len(self))[k]
        if k not in self._kept:
            frame = shrink(self._capture.frame(self.numbers[k]), self.factor)
            known = np.where(frame.depth > 0, frame.depth, FAR).clip(_MIN_DEPTH, FAR)
            share = np.log(known / _MIN_DEPTH) / np.log(FAR / _MIN_DEPTH)
            codes = np.rint(share * (_CODES - 1)) + 1
            codes = np.where(frame.depth > 0, codes, 0).astype(np.uint16)
            valid = np.ones((1, 1), bool) if frame.valid.all() else frame.valid
            nothing = np.broadcast_to(np.float32(0), codes.shape)
            self._kept[k] = replace(frame, depth=nothing, valid=valid), codes
        frame, codes = self._kept[k]
        return replace(frame, depth=_DEPTHS[codes])


class ReconstructionViews:
    """Frames of one size and K, with their photometry, for tensors on the CPU."""

    def __init__(self, frames: Sequence[CaptureFrame], photometry: Photometry):
        self.frames = frames
        edges, viewmats, outlines, depths = [], [], [], []
        for frame in Progress(frames, "loading frames", len(frames), unit="frame"):
            depth = torch.from_numpy(frame.depth)
            edges.append(depth_edge_weights(depth).to(torch.uint8))
            viewmats.append(torch.from_numpy(frame.X_WC.inverse().GetAsMatrix4()).float())
            sky = frame.depth >= FAR
            surfaces = ((frame.depth > 0) & ~sky).any()
            outlines.append(min(_OUTLINES * sky.mean(), 0.5) if surfaces else 0.0)
            sparse = frame.depth[::_SPARSE, ::_SPARSE]
            depths.append(sparse[(sparse > 0) & (sparse < FAR)])
        self.edges = torch.stack(edges)  # (n, H, W) weights of the depth term
        self.viewmats = torch.stack(viewmats)  # (n, 4, 4) X_CW
        # (n,) of the steps, which fit the outlines of surfaces before the sky
        self.outline_shares = outlines
        known = np.concatenate(depths)
        self.median_depth = float(np.median(known)) if len(known) else 0.0  # [m]
        self.K = torch.from_numpy(frames[0].K).float()[None]  # (1, 3, 3) [px]
        self.height, self.width = self.edges.shape[1:]
        self.vignetting = photometry.vignetting
        self.gains = torch.from_numpy(photometry.gains).float()  # (n,)
        vignette = photometry.factor(0, self.height, self.width) / photometry.gains[0]
        self.vignette = torch.from_numpy(vignette).float()  # (H, W)

    def __len__(self) -> int:
        return len(self.frames)

    def digest(self) -> str:
        """Returns a digest of images, depths and cameras."""
        digest = hashlib.sha256()
        for tensor in (self.viewmats, self.K, self.gains):
            digest.update(tensor.numpy().tobytes())
        for frame in self.frames:
            for array in (frame.image, frame.depth, frame.valid):
                digest.update(array.tobytes())
        return digest.hexdigest()

    def camera(self, k: int, device: str) -> tuple[Tensor, Tensor]:
        """Returns X_CW (1, 4, 4) and K (1, 3, 3) [px] of view k on a device."""
        return self.viewmats[k : k + 1].to(device), self.K.to(device)

    def extent(self) -> tuple[NDArray[np.float64], float]:
        """Returns the mean position (3,) [m] of the cameras and 1.1 times the largest distance from
        it [m], which scales sizes and the rate of the means; 1 m if all cameras coincide."""
        X_CWs = self.viewmats.double().numpy()
        p_WCs = -np.einsum("nji,nj->ni", X_CWs[:, :3, :3], X_CWs[:, :3, 3])
        center = p_WCs.mean(axis=0)
        extent = 1.1 * float(np.linalg.norm(p_WCs - center, axis=1).max())
        return center, extent if extent > 1e-6 else 1.0

    def target(self, frame: CaptureFrame, gain: Tensor, background: Tensor) -> Tensor:
        """Returns the image (H, W, 3) of a frame without gain and vignetting, on `background`."""
        image = torch.from_numpy(frame.image).float()
        color = image.mul_((1 / (255 * gain * self.vignette))[..., None])
        color[torch.from_numpy(frame.depth >= FAR)] = background
        return color


def learn_background(frames: Sequence[CaptureFrame], photometry: Photometry) -> Background:
    """Learns the sky: each texel has the mean color, without gains and vignetting, of the pixels
    that look into it, or is interpolated. Without any sky, returns the mean color of the frames."""
    mean = np.zeros(3)
    sums, counts = np.zeros((_HEIGHT * _WIDTH, 3)), np.zeros(_HEIGHT * _WIDTH)
    for k, frame in enumerate(frames):
        sky = frame.depth >= FAR
        factor = photometry.factor(k, *sky.shape)
        valid = frame.valid[::_SPARSE, ::_SPARSE]
        if valid.any():
            image = frame.image[::_SPARSE, ::_SPARSE] / (255 * factor[::_SPARSE, ::_SPARSE, None])
            mean += image[valid].mean(axis=0) / len(frames)
        if not sky.any():
            continue
        color = frame.image[sky] / (255 * factor[sky])[:, None]
        v_W = pixel_rays(frame.slopes[sky], frame.X_WC)
        row, column = texel_position(v_W, _HEIGHT, _WIDTH)
        row, column = np.minimum(row.astype(int), _HEIGHT - 1), column.astype(int) % _WIDTH
        np.add.at(sums, row * _WIDTH + column, color)
        np.add.at(counts, row * _WIDTH + column, 1)
    if not counts.any():
        return tuple(mean.clip(0, 1).tolist())
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
