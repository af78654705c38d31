"""Times the CPU splat renderer and checks it against the vectorised torch reference.

    python benchmarks/rasterize.py

With FLYSPLAT_DATA set, the scene is 100,000 points of TartanAir's hospital corridor, back-projected
from depth; otherwise a synthetic room of the same size. "rasterize" is the whole call on torch
tensors, with its checks and meta; "baked" is BakedScene.render. Times are of the wall clock, in
milliseconds; on a busy machine the minimum is what to read.
"""

import importlib.util
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from flysplat import _native
from flysplat.systems.splats import rasterize
from flysplat.systems.splats.baked_scene import BakedScene
from flysplat.systems.splats.gaussian_scene import GaussianScene

COUNT = 100_000
REPEATS = 30
# Optical axes (x right, y down, z forward) in the forward-right-down body of TartanAir's poses.
R_BC = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def load_reference():
    path = Path(__file__).parents[1] / "tests/systems/splats/reference_rasterizer.py"
    spec = importlib.util.spec_from_file_location("reference_rasterizer", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def hospital(folder: Path) -> tuple[GaussianScene, RigidTransform]:
    """Every tenth frame on a regular grid of pixels; Gaussians as wide as the grid is coarse."""
    poses = []
    for x, y, z, qx, qy, qz, qw in np.loadtxt(folder / "pose_left.txt"):
        w, x_, y_, z_ = np.array([qw, qx, qy, qz]) / np.linalg.norm([qw, qx, qy, qz])
        R_WC = RotationMatrix(Quaternion(w=w, x=x_, y=y_, z=z_)).matrix() @ R_BC
        poses.append(RigidTransform(RotationMatrix(R_WC), np.array([x, y, z])))
    means, scales, colors = [], [], []
    frames = range(0, len(poses), 10)
    step = 4
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
    chosen = np.random.default_rng(0).permutation(sum(map(len, scales)))[:COUNT]
    scene = from_points(
        np.concatenate(means)[chosen],
        np.concatenate(scales)[chosen],
        np.concatenate(colors)[chosen],
    )
    return scene, poses[len(poses) // 2]


def synthetic_room() -> tuple[GaussianScene, RigidTransform]:
    """Points on the walls of a room, seen from inside."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (COUNT, 3))
    means[np.arange(COUNT), rng.integers(0, 3, COUNT)] = rng.choice([-1.0, 1.0], COUNT)
    means *= [4.0, 3.0, 1.5]
    scene = from_points(means, np.full(COUNT, 0.02), rng.uniform(0, 1, (COUNT, 3)))
    return scene, RigidTransform(RotationMatrix(R_BC), np.array([-2.0, 0.5, 0.0]))


def from_points(means: np.ndarray, scales: np.ndarray, colors: np.ndarray) -> GaussianScene:
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    opacities = np.random.default_rng(1).uniform(0.8, 0.95, count)
    return GaussianScene.from_colors(
        means, quats, np.repeat(scales[:, None], 3, axis=1), opacities, colors
    )


def milliseconds(call: Callable[[], object], repeats: int = REPEATS) -> tuple[float, float]:
    """Minimum and median duration."""
    durations = []
    call()
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        durations.append(1e3 * (time.perf_counter() - start))
    return min(durations), float(np.median(durations))


def machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines()
                 if line.startswith("model name")]  # fmt: skip
        model = names[0] if names else model
    levels = ", ".join(_native.simd_levels())
    return f"{model}, {os.cpu_count()} cores, {platform.platform()}, SIMD levels {levels}"


def intrinsics(width: int, height: int) -> np.ndarray:
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])


def tensors_of(scene: GaussianScene) -> dict[str, Any]:
    arrays = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")}
    arrays["colors"] = scene.base_colors
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def cameras_of(X_WC: RigidTransform, width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """viewmats (1, 4, 4) and Ks (1, 3, 3)."""
    X_CW = X_WC.inverse().GetAsMatrix4()
    return (
        torch.tensor(X_CW, dtype=torch.float32)[None],
        torch.tensor(intrinsics(width, height), dtype=torch.float32)[None],
    )


def calls(
    scene: GaussianScene, X_WC: RigidTransform, width: int, height: int, simd: str, threads: int
) -> dict[str, Callable[[], object]]:
    tensors = tensors_of(scene)
    viewmats, Ks = cameras_of(X_WC, width, height)
    baked = BakedScene(scene, threads=threads, simd=simd)

    def call(render_mode: str) -> Callable[[], object]:
        return lambda: rasterize(
            **tensors,
            viewmats=viewmats,
            Ks=Ks,
            width=width,
            height=height,
            render_mode=render_mode,
            threads=threads,
            simd=simd,
        )

    K = intrinsics(width, height)
    return {
        "rasterize RGB": call("RGB"),
        "rasterize RGB+ED": call("RGB+ED"),
        "baked RGB+ED": lambda: baked.render(K, width, height, X_WC),
    }


def main() -> None:
    torch.set_num_threads(1)
    data = os.environ.get("FLYSPLAT_DATA")
    name = "TartanAir hospital" if data else "synthetic room"
    scene, X_WC = hospital(Path(data) / "tartanair/hospital") if data else synthetic_room()
    print(machine())

    width, height = 320, 240
    tensors = tensors_of(scene)
    viewmats, Ks = cameras_of(X_WC, width, height)
    reference = load_reference()
    start = time.perf_counter()
    view = {"viewmat": viewmats[0], "K": Ks[0], "width": width, "height": height}
    reference.render(**tensors, **view, dtype=torch.float32)
    reference_ms = 1e3 * (time.perf_counter() - start)
    expected = reference.render(**tensors, **view)
    image, alpha, meta = rasterize(
        **tensors, viewmats=viewmats, Ks=Ks, width=width, height=height, render_mode="RGB+D"
    )
    print(
        f"{name}: {len(scene):,} Gaussians, {len(meta['gaussian_ids']):,} visible at 320x240, mean "
        f"alpha {alpha.mean():.3f}\nvectorised torch reference (float32, one thread) at 320x240: "
        f"{reference_ms:.0f} ms\n"
    )

    print("| call | size | SIMD | threads | min ms | median ms | reference / min |")
    print("|---|---|---|---|---|---|---|")
    levels = _native.simd_levels()
    cases = [(size, levels[0], 1) for size in ((160, 120), (320, 240), (640, 480))]
    cases += [((320, 240), level, 1) for level in levels[1:]]
    cases += [((320, 240), levels[0], 2)]
    for (w, h), simd, threads in cases:
        for label, call in calls(scene, X_WC, w, h, simd, threads).items():
            least, median = milliseconds(call)
            ratio = f"{reference_ms / least:.0f}" if (w, h) == (width, height) else ""
            row = (label, f"{w}x{h}", simd, threads, f"{least:.2f}", f"{median:.2f}", ratio)
            print("| " + " | ".join(map(str, row)) + " |", flush=True)

    print("\nagreement with the float64 reference at 320x240, by pixel:")
    clear = expected.margin > 1e-4
    for label, got, want in (
        ("colour", image[0, ..., :3], expected.color),
        ("accumulated depth", image[0, ..., 3], expected.depth),
        ("alpha", alpha[0, ..., 0], expected.alpha),
    ):
        error = (got.double() - want).abs()
        p99 = np.quantile(error[clear].numpy(), 0.99)
        print(
            f"  {label}: median {error.median():.1e}, p99 {p99:.1e}, max {error[clear].max():.1e}; "
            f"within rounding of a threshold {int((~clear).sum())} of {clear.numel()} pixels, "
            f"max there {error[~clear].max() if (~clear).any() else 0:.1e}"
        )


if __name__ == "__main__":
    main()
