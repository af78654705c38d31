"""Timing, tables and scenes that the benchmarks share."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from pydrake.math import RigidTransform, RotationMatrix
from torch import Tensor

from splatpilot.systems.common.files import DATA, data_folder
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import depth_points
from splatpilot.training.captures.capture_registry import read_capture


def peak_growth(call: Callable[[], object]) -> float:
    """Returns the MiB by which the resident memory peaks during a first call."""

    def value(key: str) -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(key)).split()[1]) / 1024

    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = value("VmRSS")
    call()
    return value("VmHWM") - before


def row(*cells: object) -> None:
    """Prints a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def header(*cells: str) -> None:
    """Prints the first rows of a Markdown table."""
    print()
    row(*cells)
    print("|---" * len(cells) + "|", flush=True)


def scene_name() -> str:
    return "TartanAir hospital" if DATA in os.environ else "synthetic room"


def load_scene(count: int) -> tuple[GaussianScene, RigidTransform]:
    """Returns a scene of `count` Gaussians and a camera's pose X_WC in it: TartanAir's hospital if
    SPLATPILOT_DATA is set, else a synthetic room."""
    data = data_folder()
    return hospital(data / "tartanair" / "hospital", count) if data else synthetic_room(count)


def hospital(folder: Path, count: int) -> tuple[GaussianScene, RigidTransform]:
    """Back-projects a regular grid of pixels of every tenth frame."""
    capture = read_capture(folder)
    step = 4 if count <= 150_000 else 2
    means, scales, colors = [], [], []
    for i in range(0, len(capture), 10):
        frame = capture.frame(i)
        near = np.where(frame.depth < 30.0, frame.depth, 0.0)
        p_CQ, rows, columns = depth_points(frame.K, near, step)
        means.append(frame.X_WC.multiply(p_CQ.T).T)
        scales.append(1.2 * p_CQ[:, 2] / 160)  # 1.2 pixels of the 320x240 images
        colors.append(frame.image[rows, columns] / 255)
    chosen = np.random.default_rng(0).permutation(sum(map(len, scales)))[:count]
    arrays = (np.concatenate(values)[chosen] for values in (means, scales, colors))
    return round_gaussians(*arrays), capture.X_WCs[len(capture) // 2]


def synthetic_room(count: int) -> tuple[GaussianScene, RigidTransform]:
    """Draws points on the walls of a room, seen from inside."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (count, 3))
    means[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    means *= [4.0, 3.0, 1.5]
    scene = round_gaussians(means, np.full(count, 0.02), rng.uniform(0, 1, (count, 3)))
    R_WC = RotationMatrix(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))
    return scene, RigidTransform(R_WC, np.array([-2.0, 0.5, 0.0]))


def round_gaussians(means: np.ndarray, scales: np.ndarray, colors: np.ndarray) -> GaussianScene:
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    opacities = np.random.default_rng(1).uniform(0.8, 0.95, count)
    scales = np.repeat(scales[:, None], 3, axis=1)
    return GaussianScene.from_colors(means, quats, scales, opacities, colors)


def intrinsics(width: int, height: int) -> np.ndarray:
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])


def scene_tensors(scene: GaussianScene) -> dict[str, Tensor]:
    arrays = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")}
    arrays["colors"] = scene.base_colors
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def camera_tensors(X_WC: RigidTransform, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Returns viewmats (1, 4, 4) and Ks (1, 3, 3)."""
    matrices = X_WC.inverse().GetAsMatrix4(), intrinsics(width, height)
    viewmat, K = (torch.tensor(matrix, dtype=torch.float32)[None] for matrix in matrices)
    return viewmat, K
