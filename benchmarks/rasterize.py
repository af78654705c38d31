"""Times the CPU splat renderers: by size, SIMD level and harmonics; surfels; without gradients.

    python benchmarks/rasterize.py

The scenes are 100,000 and 500,000 points of TartanAir's hospital corridor, in SPLATPILOT_DATA.
"forward" is the whole call on torch tensors; "+ backward" adds the gradients of all scene tensors.
Times are CPU milliseconds of the process, the minimum of many calls, with one thread.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydrake.math import RigidTransform

from splatpilot import _native
from splatpilot.analysis.headlines import machine, milliseconds, scene_tensors
from splatpilot.systems.common.files import find_data
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.rasterization import rasterize
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh
from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels
from splatpilot.training.captures.capture import depth_points, pinhole
from splatpilot.training.captures.capture_registry import read_capture

COUNTS = (100_000, 500_000)
SIZES = ((160, 120), (320, 240), (640, 480))


def hospital(count: int) -> tuple[GaussianScene, RigidTransform]:
    """Returns `count` back-projected Gaussians of every tenth frame, and a pose X_WC among them."""
    capture = read_capture(find_data(Path("tartanair/hospital"), "TartanAir's hospital"))
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
    means, scales, colors = (np.concatenate(each)[chosen] for each in (means, scales, colors))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    opacities = np.random.default_rng(1).uniform(0.8, 0.95, count)
    scales = np.repeat(scales[:, None], 3, axis=1)
    scene = GaussianScene.from_colors(means, quats, scales, opacities, colors)
    return scene, capture.X_WCs[len(capture) // 2]


def intrinsics(width: int, height: int) -> np.ndarray:
    return pinhole(width / 2, width / 2, width / 2, height / 2)


def print_steps(scene: GaussianScene, X_WC: RigidTransform) -> None:
    levels = _native.simd_levels()
    cases: list[tuple] = [("RGB", size, levels[0], None, rasterize) for size in SIZES]
    if len(scene) == COUNTS[0]:
        cases += [("RGB", (320, 240), level, None, rasterize) for level in levels[1:]]
        cases += [("SH 3", (320, 240), levels[0], 3, rasterize)]
        cases += [("surfels", (320, 240), levels[0], None, rasterize_surfels)]
    for name, (width, height), simd, degree, draw in cases:
        given = scene_tensors(scene, (intrinsics(width, height), width, height), [X_WC])
        given |= {"renderer": create_renderer(1, simd), "sh_degree": degree}
        if degree is not None:
            sh = np.zeros((len(scene), (degree + 1) ** 2, 3), np.float32)
            sh[:, 0] = color_to_sh(scene.base_colors)
            given["colors"] = torch.from_numpy(sh)
        leaves = [given[name] for name in ("means", "quats", "scales", "opacities", "colors")]
        upstream = torch.randn(1, height, width, 3)

        def forward(draw: Callable = draw, given: dict[str, Any] = given) -> torch.Tensor:
            return draw(**given)[0]

        def backward(upstream: torch.Tensor = upstream, forward: Callable = forward) -> None:
            forward().backward(upstream)

        times = [milliseconds(forward)]
        for leaf in leaves:
            leaf.requires_grad_()
        times.append(milliseconds(backward))
        shown = " | ".join(f"{time:.2f}" for time in times)
        print(f"| {len(scene):,} | {width}x{height} | {name} | {simd} | {shown} |", flush=True)


def print_baked(scene: GaussianScene, X_WC: RigidTransform) -> None:
    baked, renderer = BakedScene(scene), create_renderer()
    for width, height in SIZES:
        view = intrinsics(width, height), width, height
        given = scene_tensors(scene, view, [X_WC]) | {"render_mode": "RGB+MD", "renderer": renderer}
        calls = partial(rasterize, **given), partial(baked.render, *view, X_WC)
        times = " | ".join(f"{milliseconds(call):.2f}" for call in calls)
        print(f"| {width}x{height} | {times} |", flush=True)


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(machine())
    print("\n| Gaussians | size | color | SIMD | forward | + backward |\n" + "|---" * 6 + "|")
    for count in COUNTS:
        print_steps(*hospital(count))
    print("\n| RGB and median depth, no gradients | rasterize | baked |\n" + "|---" * 3 + "|")
    print_baked(*hospital(COUNTS[0]))


if __name__ == "__main__":
    main()
