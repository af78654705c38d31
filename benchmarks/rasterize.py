"""Times the CPU splat renderers: by size, SIMD level, harmonics; surfels; baked; depth; lenses.

    python benchmarks/rasterize.py

With SPLATPILOT_DATA set, the scenes are 100,000 and 500,000 points of TartanAir's hospital
corridor; otherwise a synthetic room of the same size. "forward" is the whole call on torch tensors;
"+ backward" adds the gradients of all scene tensors. Times are CPU milliseconds of the process, the
minimum of many calls, with one thread.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from harness import (
    camera_tensors,
    header,
    intrinsics,
    load_scene,
    peak_growth,
    row,
    scene_name,
    scene_tensors,
)
from pydrake.math import RigidTransform

from splatpilot import _native
from splatpilot.analysis.headlines import machine, milliseconds
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats import rasterize, rasterize_surfels
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh

COUNTS = (100_000, 500_000)
SIZES = ((160, 120), (320, 240), (640, 480))


def step_calls(
    scene: GaussianScene,
    X_WC: RigidTransform,
    size: tuple[int, int],
    simd: str = "",
    sh_degree: int | None = None,
    draw: Callable[..., Any] = rasterize,
) -> dict[str, Callable[[], object]]:
    """Returns forward, and forward with backward, of RGB images."""
    width, height = size
    renderer = create_renderer(1, simd)
    leaves = {name: t.clone().requires_grad_() for name, t in scene_tensors(scene).items()}
    if sh_degree is not None:
        coefficients = np.zeros((len(scene), (sh_degree + 1) ** 2, 3), np.float32)
        coefficients[:, 0] = color_to_sh(scene.base_colors)
        leaves["colors"] = torch.from_numpy(coefficients).requires_grad_()
    viewmats, Ks = camera_tensors(X_WC, width, height)
    upstream = torch.randn(1, height, width, 3)
    view = {"viewmats": viewmats, "Ks": Ks, "width": width, "height": height}

    def forward() -> torch.Tensor:
        return draw(**leaves, **view, sh_degree=sh_degree, renderer=renderer)[0]

    def forward_only() -> None:
        with torch.no_grad():
            forward()

    def backward() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        forward().backward(upstream)

    return {"forward": forward_only, "+ backward": backward}


def print_steps(scene: GaussianScene, X_WC: RigidTransform) -> None:
    levels = _native.simd_levels()
    cases: list[tuple] = [("RGB", size, levels[0], None, rasterize) for size in SIZES]
    if len(scene) == COUNTS[0]:
        cases += [("RGB", (320, 240), level, None, rasterize) for level in levels[1:]]
        cases += [("SH 3", (320, 240), levels[0], 3, rasterize)]
        cases += [("surfels", (320, 240), levels[0], None, rasterize_surfels)]
    for name, size, simd, degree, draw in cases:
        calls = step_calls(scene, X_WC, size, simd, degree, draw)
        times = [f"{milliseconds(call):.2f}" for call in calls.values()]
        row(f"{len(scene):,}", f"{size[0]}x{size[1]}", name, simd, *times)


def print_baked(scene: GaussianScene, X_WC: RigidTransform) -> None:
    header("RGB and median depth, no gradients", "rasterize", "baked")
    baked, renderer = BakedScene(scene), create_renderer()
    for width, height in SIZES:
        viewmats, Ks = camera_tensors(X_WC, width, height)
        arguments: dict[str, Any] = scene_tensors(scene) | {"viewmats": viewmats, "Ks": Ks}
        arguments |= {"width": width, "height": height, "render_mode": "RGB+MD"}
        arguments["renderer"] = renderer
        camera = intrinsics(width, height), width, height, X_WC
        calls = (lambda a=arguments: rasterize(**a)), (lambda c=camera: baked.render(*c))
        row(f"{width}x{height}", *(f"{milliseconds(call):.2f}" for call in calls))


def print_depth() -> None:
    """Times depth images of generated worlds from the start of their first flights."""
    header("depth [ms]", "image", "color and depth", "depth", "to 20 m", "to 6 m")
    for name in ("P01", "P02", "P05", "P08"):
        scenario = load_config(Scenario(), scenario_file(name))
        world = make_world(scenario.world, scenario.seed)
        X_WB = RigidTransform(sample_initial_state(scenario, world)[:3])
        for width, height in ((64, 36), (320, 240)):
            optics = OnboardCamera(width=width, height=height)
            info, X_WC = optics.camera_info(), X_WB @ optics.mount()
            camera = (info.intrinsic_matrix(), width, height, X_WC)
            calls: list[Callable[[], object]] = [lambda c=camera, w=world: w.baked.render(*c)]
            for limit in (np.inf, 20.0, 6.0):
                calls.append(
                    lambda c=camera, w=world, m=limit: w.baked.render_depth(*c, max_depth=m)
                )
            row(name, f"{width}x{height}", *(f"{milliseconds(call):.2f}" for call in calls))


def print_lenses(scene: GaussianScene, X_WC: RigidTransform) -> None:
    header("lenses in flight, 320x240", "ms")
    baked, K = BakedScene(scene), intrinsics(320, 240)
    lenses = {
        "pinhole": None,
        "OpenCV, k1 k2 k3 and p1 p2": Distortion("opencv", [-0.28, 0.09, -0.012], [0.003, -0.002]),
        "fisheye": Distortion("fisheye", [0.04, -0.01]),
    }
    for name, lens in lenses.items():
        ms = milliseconds(lambda lens=lens: baked.render(K, 320, 240, X_WC, distortion=lens))
        row(name, f"{ms:.2f}")


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(machine())
    scene, X_WC = load_scene(COUNTS[0])
    calls = step_calls(scene, X_WC, (320, 240))
    peaks = ", ".join(f"{label} {peak_growth(call):.0f} MiB" for label, call in calls.items())
    print(f"{scene_name()}; peak growth of resident memory in first calls at 320x240: {peaks}")
    header("Gaussians", "size", "color", "SIMD", "forward", "+ backward")
    for count in COUNTS:
        print_steps(*load_scene(count))
    print_baked(scene, X_WC)
    print_depth()
    print_lenses(scene, X_WC)


if __name__ == "__main__":
    main()
