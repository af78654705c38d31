"""Random scenes that are bitwise identical on every machine.

Only uniform numbers and operations that IEEE 754 rounds correctly (+, -, *, /, square roots and
powers of two), one at a time in float64, and one rounding to float32 at the end: exponentials,
logarithms and sums in another order differ from one processor or library to the next.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor


def normal(generator: np.random.Generator, *shape: int) -> np.ndarray:
    """Very nearly normal, float64: the sum of twelve uniform numbers, less six."""
    total = np.full(shape, -6.0)
    for _ in range(12):
        total += generator.random(shape)
    return total


def power_of_two(x: np.ndarray) -> np.ndarray:
    """2^x, linear between integers x."""
    whole = np.floor(x)
    return np.ldexp(1.0 + (x - whole), whole.astype(int))


def normal_tensor(seed: int, *shape: int) -> Tensor:
    """`normal` as float32."""
    return torch.from_numpy(normal(np.random.default_rng(seed), *shape).astype(np.float32))


def random_scene(
    count: int = 300,
    seed: int = 0,
    sh_degree: int | None = None,
    cameras: int = 1,
    size: tuple[int, int] = (67, 45),
    log2_scale: tuple[float, float] = (-3.6, 1.4),
) -> dict[str, Any]:
    """Needles, discs and blobs in front of, around and behind cameras that look at the origin.

    `log2_scale` is the mean and the standard deviation of the scales' binary logarithm.
    """
    generator = np.random.default_rng(seed)
    mean, deviation = log2_scale
    scene = {
        "means": 1.5 * normal(generator, count, 3),
        "quats": 3.0 * normal(generator, count, 4),
        "scales": power_of_two(mean + deviation * normal(generator, count, 3)),
        "opacities": generator.random(count),
        "colors": generator.random((count, 3)),
    }
    if sh_degree is not None:
        scene["colors"] = 0.4 * normal(generator, count, (sh_degree + 1) ** 2, 3)
    width, height = size
    K = [[0.9 * width, 0, 0.48 * width], [0, 1.1 * width, 0.55 * height], [0, 0, 1]]
    scene["Ks"] = np.tile(K, (cameras, 1, 1))
    scene["viewmats"] = np.tile(np.eye(4), (cameras, 1, 1))
    for c in range(cameras):
        w, x, y, z = (float(a) for a in 0.1 * normal(generator, 4))
        scene["viewmats"][c, :3, :3] = rotation_matrix(w + 1.0, x, y, z)
        scene["viewmats"][c, 2, 3] = 3.0 + c
    return {k: torch.from_numpy(a.astype(np.float32)) for k, a in scene.items()}


def rotation_matrix(w: float, x: float, y: float, z: float) -> list[list[float]]:
    """(3, 3) of a quaternion of any length but zero."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
