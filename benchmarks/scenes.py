"""The scenes that the renderer's benchmarks draw.

With SPLATPILOT_DATA set, points of TartanAir's hospital corridor, back-projected from depth;
otherwise a synthetic room of the same size.
"""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.splats.scene import GaussianScene

# Optical axes (x right, y down, z forward) in the forward-right-down body of TartanAir's poses.
R_BC = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def scene_name() -> str:
    return "TartanAir hospital" if "SPLATPILOT_DATA" in os.environ else "synthetic room"


def hospital(folder: Path, count: int) -> tuple[GaussianScene, RigidTransform]:
    """Every tenth frame on a regular grid of pixels; Gaussians as wide as the grid is coarse."""
    poses = []
    for x, y, z, qx, qy, qz, qw in np.loadtxt(folder / "pose_left.txt"):
        w, x_, y_, z_ = np.array([qw, qx, qy, qz]) / np.linalg.norm([qw, qx, qy, qz])
        R_WC = RotationMatrix(Quaternion(w=w, x=x_, y=y_, z=z_)).matrix() @ R_BC
        poses.append(RigidTransform(RotationMatrix(R_WC), np.array([x, y, z])))
    means, scales, colors = [], [], []
    frames = range(0, len(poses), 10)
    step = 4 if count <= 150_000 else 2
    for frame in frames:
        depth = np.load(folder / f"depth_left/{frame:06d}_left_depth.npy")[::step, ::step]
        image = cv2.imread(str(folder / f"image_left/{frame:06d}_left.png"))
        assert image is not None
        v, u = np.mgrid[0:480:step, 0:640:step] + 0.5
        near = depth < 30.0
        z = depth[near]
        p_C = np.stack([(u[near] - 320) / 320 * z, (v[near] - 240) / 320 * z, z], axis=-1)
        means.append(p_C @ poses[frame].rotation().matrix().T + poses[frame].translation())
        # 1.2 pixels of the 320x240 images that are rendered.
        scales.append(1.2 * z / 160)
        colors.append(image[::step, ::step, ::-1][near] / 255.0)
    chosen = np.random.default_rng(0).permutation(sum(map(len, scales)))[:count]
    scene = from_points(
        np.concatenate(means)[chosen],
        np.concatenate(scales)[chosen],
        np.concatenate(colors)[chosen],
    )
    return scene, poses[len(poses) // 2]


def synthetic_room(count: int) -> tuple[GaussianScene, RigidTransform]:
    """Points on the walls of a room, seen from inside."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (count, 3))
    means[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    means *= [4.0, 3.0, 1.5]
    scene = from_points(means, np.full(count, 0.02), rng.uniform(0, 1, (count, 3)))
    return scene, RigidTransform(RotationMatrix(R_BC), np.array([-2.0, 0.5, 0.0]))


def from_points(means: np.ndarray, scales: np.ndarray, colors: np.ndarray) -> GaussianScene:
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    opacities = np.random.default_rng(1).uniform(0.8, 0.95, count)
    return GaussianScene.from_colors(
        means, quats, np.repeat(scales[:, None], 3, axis=1), opacities, colors
    )


def load_scene(count: int) -> tuple[GaussianScene, RigidTransform]:
    data = os.environ.get("SPLATPILOT_DATA")
    return hospital(Path(data) / "tartanair/hospital", count) if data else synthetic_room(count)


def intrinsics(width: int, height: int) -> np.ndarray:
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])


def scene_tensors(scene: GaussianScene) -> dict[str, Any]:
    arrays = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")}
    arrays["colors"] = scene.base_colors
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def camera_tensors(
    X_WC: RigidTransform, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """viewmats (1, 4, 4) and Ks (1, 3, 3)."""
    X_CW = X_WC.inverse().GetAsMatrix4()
    return (
        torch.tensor(X_CW, dtype=torch.float32)[None],
        torch.tensor(intrinsics(width, height), dtype=torch.float32)[None],
    )
