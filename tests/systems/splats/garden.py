"""gsplat's test scene: points of the garden as random Gaussians, as in gsplat's tests."""

from pathlib import Path

import numpy as np
import torch
from random_scenes import normal_tensor
from torch import Tensor

HALF = 2.0  # [m] of the cube about the origin that is kept
SCALES = (1e-4, 0.02)  # [m]


def load_garden(data: Path, count: int) -> tuple[dict[str, Tensor], Tensor, Tensor, int, int]:
    """Returns `count` Gaussians, viewmats (3, 4, 4), Ks (3, 3, 3), width and height."""
    arrays = np.load(data / "test_garden.npz")
    g = torch.Generator().manual_seed(42)
    means, colors = torch.from_numpy(arrays["means3d"]), torch.from_numpy(arrays["colors"]) / 255
    inside = torch.nonzero((means.abs() <= HALF).all(1))[:, 0]
    inside = inside[torch.randperm(len(inside), generator=g)[:count]]
    N = len(inside)
    scene = {
        "means": means[inside],
        "quats": normal_tensor(42, N, 4),
        "scales": SCALES[0] + (SCALES[1] - SCALES[0]) * torch.rand(N, 3, generator=g),
        "opacities": torch.rand(N, generator=g),
        "colors": colors[inside].float(),
    }
    viewmats, Ks = (torch.from_numpy(arrays[name]).float() for name in ("viewmats", "Ks"))
    return scene, viewmats, Ks, int(arrays["width"]), int(arrays["height"])
