"""The images that a reconstruction is compared with, shrunk and ready."""

from collections.abc import Sequence
from functools import cache
from typing import overload

import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from torch import Tensor

from splatpilot.systems.progress import Progress
from splatpilot.systems.splats.background import FAR
from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.captures.shrink_frame import shrink
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
