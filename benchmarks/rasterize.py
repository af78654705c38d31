"""Times the CPU splat renderer: by size, SIMD level, threads, spherical harmonics; baked; memory.

    python benchmarks/rasterize.py [--opensplat PATH]

With SPLATPILOT_DATA set, the scenes are 100,000 and 500,000 points of TartanAir's hospital
corridor; otherwise a synthetic room of the same size. "forward" is the whole call of `rasterize` on
torch tensors, with its checks and meta; "+ backward" adds the gradients of all scene tensors and "+
Adam" torch's fused optimiser; "baked" is BakedScene.render. Times are CPU milliseconds of the
process, the least of many calls; those by threads are of the wall clock, and too long on a machine
that is not idle. PATH is a checkout of OpenSplat,
whose CPU rasteriser is then built and timed (see opensplat.py).
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from agreement import load_reference
from harness import header, machine, milliseconds, peak_growth, row
from kernels import print_limits, print_raster_kernel
from pydrake.math import RigidTransform
from scenes import cameras_of, intrinsics, load_scene, scene_name, tensors_of

from splatpilot import _native
from splatpilot.diagrams.flight.flight import sample_initial_state
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene

COUNTS = (100_000, 500_000)
SIZES = ((160, 120), (320, 240), (640, 480))
SCALING_ROUNDS = 40


def step_calls(
    scene: GaussianScene, X_WC: RigidTransform, size: tuple[int, int], renderer: _native.Renderer,
    sh_degree: int | None = None,
) -> dict[str, Callable[[], object]]:  # fmt: skip
    """forward, forward + backward, and these with an optimiser's step, of RGB images."""
    width, height = size
    leaves = {name: t.clone().requires_grad_() for name, t in tensors_of(scene).items()}
    if sh_degree is not None:
        coefficients = torch.zeros(len(scene), (sh_degree + 1) ** 2, 3)
        coefficients[:, 0] = (leaves["colors"].detach() - 0.5) / 0.28209479177387814
        leaves["colors"] = coefficients.requires_grad_()
    viewmats, Ks = cameras_of(X_WC, width, height)
    optimizer = torch.optim.Adam(leaves.values(), lr=0.0, fused=True)
    upstream = torch.randn(1, height, width, 3)

    def forward() -> torch.Tensor:
        return rasterize(
            **leaves, viewmats=viewmats, Ks=Ks, width=width, height=height,
            sh_degree=sh_degree, renderer=renderer,
        )[0]  # fmt: skip

    def forward_only() -> None:
        with torch.no_grad():
            forward()

    def backward() -> None:
        optimizer.zero_grad()
        forward().backward(upstream)

    def step() -> None:
        backward()
        optimizer.step()

    return {"forward": forward_only, "+ backward": backward, "+ Adam": step}


def print_steps(scene: GaussianScene, X_WC: RigidTransform) -> None:
    levels = _native.simd_levels()
    cases: list[tuple] = [(size, levels[0], None) for size in SIZES]
    if len(scene) == COUNTS[0]:
        cases += [((320, 240), level, None) for level in levels[1:]]
        cases += [((320, 240), levels[0], degree) for degree in (0, 1, 2, 3)]
    for size, simd, degree in cases:
        calls = step_calls(scene, X_WC, size, create_renderer(1, simd), degree)
        least = [f"{milliseconds(call)[0]:.2f}" for call in calls.values()]
        colour = "RGB" if degree is None else f"SH {degree}"
        row(f"{len(scene):,}", f"{size[0]}x{size[1]}", colour, simd, *least)


def print_scaling(scene: GaussianScene, X_WC: RigidTransform) -> None:
    """Whole calls and native stages by threads, in turns, so that all see the same machine."""
    renderers = {n: create_renderer(n) for n in (1, 2, 4)}
    calls = {n: step_calls(scene, X_WC, (320, 240), r) for n, r in renderers.items()}
    least: dict[tuple[int, str], float] = {}

    def keep(threads: int, stage: str, duration: float) -> None:
        least[threads, stage] = min(duration, least.get((threads, stage), duration))

    for _ in range(SCALING_ROUNDS):
        for threads, by_label in calls.items():
            for label in ("forward", "+ backward"):
                for _ in range(5):
                    start = time.perf_counter()
                    by_label[label]()
                    keep(threads, label, time.perf_counter() - start)
                    if label == "+ backward":
                        for stage, seconds in renderers[threads].seconds.items():
                            keep(threads, stage, seconds)
    header("320x240, RGB", "1 thread", "2 threads", "gain", "4 threads")
    for stage in dict.fromkeys(stage for _, stage in least):
        one, two, four = (1e3 * least[threads, stage] for threads in (1, 2, 4))
        row(stage, f"{one:.2f}", f"{two:.2f}", f"{one / two:.2f}", f"{four:.2f}")


def print_baked(scene: GaussianScene, X_WC: RigidTransform) -> None:
    header("RGB+MD without gradients", "rasterize", "baked", "gain")
    baked, renderer = BakedScene(scene), create_renderer()
    for width, height in SIZES:
        viewmats, Ks = cameras_of(X_WC, width, height)
        arguments: dict[str, Any] = tensors_of(scene) | {"viewmats": viewmats, "Ks": Ks}
        arguments |= {"width": width, "height": height, "render_mode": "RGB+MD"}
        arguments["renderer"] = renderer
        K = intrinsics(width, height)
        plain, _ = milliseconds(lambda arguments=arguments: rasterize(**arguments))
        fast, _ = milliseconds(lambda K=K, w=width, h=height: baked.render(K, w, h, X_WC))
        row(f"{width}x{height}", f"{plain:.2f}", f"{fast:.2f}", f"{plain / fast:.2f}")


def print_depth_alone() -> None:
    """In generated worlds, from where their first flights start."""
    header("depth alone [ms]", "image", "colour and depth", "depth", "to 20 m", "to 6 m")
    for name in ("P01", "P02", "P05", "P08"):
        scenario = load_config(Scenario(), scenario_file(name))
        world = make_world(scenario.world, scenario.seed)
        X_WB = RigidTransform(sample_initial_state(scenario, world)[:3])
        for width, height in ((64, 36), (320, 240)):
            optics = OnboardCamera(width=width, height=height)
            info, X_WC = optics.camera_info(), X_WB @ optics.X_BC()
            camera = (info.intrinsic_matrix(), width, height, X_WC)
            calls: list[Callable[[], object]] = [lambda c=camera, w=world: w.baked.render(*c)]
            for most in (np.inf, 20.0, 6.0):
                calls.append(
                    lambda c=camera, w=world, m=most: w.baked.render_depth(*c, max_depth=m)
                )
            row(name, f"{width}x{height}", *(f"{milliseconds(call)[0]:.2f}" for call in calls))


def print_lenses(scene: GaussianScene, X_WC: RigidTransform) -> None:
    header("lenses in flight, 320x240", "ms")
    baked, K = BakedScene(scene), intrinsics(320, 240)
    lenses = {
        "pinhole": None,
        "OpenCV, k1 k2 k3 and p1 p2": Distortion("opencv", [-0.28, 0.09, -0.012], [0.003, -0.002]),
        "fisheye": Distortion("fisheye", [0.04, -0.01]),
    }
    for name, lens in lenses.items():
        ms, _ = milliseconds(lambda lens=lens: baked.render(K, 320, 240, X_WC, distortion=lens))
        row(name, f"{ms:.2f}")


def print_torch(scene: GaussianScene, X_WC: RigidTransform, ours: dict[str, Callable]) -> None:
    """The vectorised torch reference, in float32 on one thread, once."""
    viewmats, Ks = cameras_of(X_WC, 320, 240)
    view = {"viewmat": viewmats[0], "K": Ks[0], "width": 320, "height": 240}
    reference = load_reference()
    leaves = {name: t.requires_grad_() for name, t in tensors_of(scene).items()}
    start = time.perf_counter()
    with torch.no_grad():
        reference.render(**leaves, **view, dtype=torch.float32)
    middle = time.perf_counter()
    reference.render(**leaves, **view, dtype=torch.float32).color.sum().backward()
    theirs = (1e3 * (middle - start), 1e3 * (time.perf_counter() - middle))
    header("vectorised torch, 320x240", "ms", "ratio to ours")
    for label, ms in zip(("forward", "+ backward"), theirs, strict=True):
        row(label, f"{ms:.0f}", f"{ms / milliseconds(ours[label])[0]:.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Times the CPU splat renderer.")
    parser.add_argument("--opensplat", type=Path, metavar="PATH", help="a checkout of OpenSplat")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(machine())
    scene, X_WC = load_scene(COUNTS[0])
    calls = step_calls(scene, X_WC, (320, 240), create_renderer())
    peaks = ", ".join(f"{label} {peak_growth(call):.0f} MiB" for label, call in calls.items())
    print(f"{scene_name()}: {len(scene):,} Gaussians; one thread unless said otherwise")
    print(f"peak of resident memory above what it was, first calls at 320x240: {peaks}")
    header("Gaussians", "size", "colour", "SIMD", "forward", "+ backward", "+ Adam")
    for count in COUNTS:
        print_steps(*load_scene(count))
    print_scaling(scene, X_WC)
    print_baked(scene, X_WC)
    print_depth_alone()
    print_lenses(scene, X_WC)
    print_torch(scene, X_WC, calls)
    print_raster_kernel(scene, X_WC, arguments.opensplat)
    print_limits(scene, X_WC)


if __name__ == "__main__":
    main()
