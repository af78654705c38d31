"""Times the CPU splat renderer and checks it against the vectorised torch reference.

    python benchmarks/rasterize.py

With FLYSPLAT_DATA set, the scenes are 100,000 and 500,000 points of TartanAir's hospital corridor,
back-projected from depth; otherwise a synthetic room of the same size. "forward" is the whole call
of `rasterize` on torch tensors, with its checks and meta; "+ backward" adds the gradients of all
scene tensors and "+ Adam" torch's fused optimiser; "baked" is BakedScene.render. Times are of the
wall clock, in milliseconds; on a busy machine the minimum is what to read.
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

COUNTS = (100_000, 500_000)
# Vector instructions of the backward pass in the inner loops of native/raster_backward.hpp, counted
# by hand for RGB: a (Gaussian, 4x4 block) composited again and differentiated, and one reduction.
VECTOR_WORK = {"block": 45, "pair": 40}
REPEATS = 30
FMA_ROUNDS = 200_000
# Optical axes (x right, y down, z forward) in the forward-right-down body of TartanAir's poses.
R_BC = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def load_reference():
    path = Path(__file__).parents[1] / "tests/systems/splats/reference_rasterizer.py"
    spec = importlib.util.spec_from_file_location("reference_rasterizer", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
    data = os.environ.get("FLYSPLAT_DATA")
    return hospital(Path(data) / "tartanair/hospital", count) if data else synthetic_room(count)


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


def step_calls(
    scene: GaussianScene, X_WC: RigidTransform, size: tuple[int, int], simd: str, threads: int,
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
            sh_degree=sh_degree, threads=threads, simd=simd,
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


def print_steps() -> None:
    print("| Gaussians | size | colour | SIMD | threads | forward | + backward | + Adam |")
    print("|---|---|---|---|---|---|---|---|")
    levels = _native.simd_levels()
    for count in COUNTS:
        scene, X_WC = load_scene(count)
        cases: list[tuple] = [(s, levels[0], 1, None) for s in ((160, 120), (320, 240), (640, 480))]
        if count == COUNTS[0]:
            cases += [((320, 240), level, 1, None) for level in levels[1:]]
            cases += [((320, 240), levels[0], threads, None) for threads in (2, 4)]
            cases += [((320, 240), levels[0], 1, degree) for degree in (0, 1, 2, 3)]
        for size, simd, threads, degree in cases:
            calls = step_calls(scene, X_WC, size, simd, threads, degree)
            least = [f"{milliseconds(call)[0]:.2f}" for call in calls.values()]
            colour = "RGB" if degree is None else f"SH {degree}"
            row = (f"{count:,}", f"{size[0]}x{size[1]}", colour, simd, str(threads), *least)
            print("| " + " | ".join(row) + " |", flush=True)


def print_baked(scene: GaussianScene, X_WC: RigidTransform) -> None:
    print("\nRGB+ED without gradients, one thread:\n\n| size | rasterize | baked | gain |")
    print("|---|---|---|---|")
    baked = BakedScene(scene)
    for width, height in ((160, 120), (320, 240), (640, 480)):
        viewmats, Ks = cameras_of(X_WC, width, height)
        arguments: dict[str, Any] = tensors_of(scene) | {"viewmats": viewmats, "Ks": Ks}
        arguments |= {"width": width, "height": height, "render_mode": "RGB+ED"}
        K = intrinsics(width, height)
        plain, _ = milliseconds(lambda arguments=arguments: rasterize(**arguments))
        fast, _ = milliseconds(lambda K=K, w=width, h=height: baked.render(K, w, h, X_WC))
        print(f"| {width}x{height} | {plain:.2f} | {fast:.2f} | {plain / fast:.2f} |", flush=True)


def print_share_of_limit(scene: GaussianScene, X_WC: RigidTransform) -> None:
    """The raster kernel's backward pass against the rate of independent multiply-adds."""
    print("\nbackward raster kernel at 320x240 against the machine's multiply-adds, one thread:\n")
    print(
        "| SIMD | G multiply-adds/s | composited blocks | pairs | ms | share |\n" + "|---" * 6 + "|"
    )
    viewmats, Ks = cameras_of(X_WC, 320, 240)
    t = tensors_of(scene)
    geometry = [t[name].numpy() for name in ("means", "quats", "scales", "opacities")]
    K, X_CW = Ks[0].double().numpy(), viewmats[0].double().numpy()
    image, alpha = np.zeros((240, 320, 3), np.float32), np.zeros((240, 320, 1), np.float32)
    black = np.zeros(3, np.float32)
    v_image, v_alpha = np.ones_like(image), np.ones_like(alpha)
    for simd in _native.simd_levels():
        renderer = _native.Renderer(1, simd)
        burst, _ = milliseconds(lambda r=renderer: _native.multiply_add(r, FMA_ROUNDS), 10)
        rate = _native.multiply_add(renderer, FMA_ROUNDS)[1] / burst  # lanes per ms
        renderer.render(
            *geometry, t["colors"].numpy()[:, None], -1, K, X_CW, 320, 240, 0.01, 1e10, 0.0, 0.3,
            False, False, black, image, alpha, True,
        )  # fmt: skip
        frame = _native.kept_frame(renderer)
        gradients = np.zeros((frame.splat_count, 16), np.float32)
        call = lambda r=renderer, f=frame, g=gradients: _native.raster_backward(  # noqa: E731
            r, f, v_image, v_alpha, image, alpha, black, False, False, g, m
        )
        least, _ = milliseconds(call)
        blocks, pairs = call(), renderer.pair_count
        work = 16 * (VECTOR_WORK["block"] * blocks + VECTOR_WORK["pair"] * pairs)
        share = work / rate / least
        print(f"| {simd} | {rate / 1e6:.0f} | {blocks:,} | {pairs:,} | {least:.2f} | {share:.0%} |")


def peak_growth(call: Callable[[], object]) -> float:
    """MiB by which the resident memory peaks during a first call; Linux only."""
    resident = Path("/proc/self/status")

    def value(key: str) -> float:
        line = next(x for x in resident.read_text().splitlines() if x.startswith(key))
        return int(line.split()[1]) / 1024

    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before = value("VmRSS")
    call()
    return value("VmHWM") - before


def print_gradient_agreement(scene: GaussianScene, X_WC: RigidTransform, reference: Any) -> None:
    """Row by row, |gradient - float64 gradient| / |float64 gradient|; at 160x120, for memory."""
    viewmats, Ks = cameras_of(X_WC, 160, 120)
    view: dict[str, Any] = {"viewmat": viewmats[0], "K": Ks[0], "width": 160, "height": 120}
    wide = {name: t.double().requires_grad_() for name, t in tensors_of(scene).items()}
    expected = reference.render(**wide, **view)
    clear = expected.margin > 1e-3
    upstream = torch.randn(120, 160, 3) * clear[..., None]
    expected.color.backward(upstream.double())
    narrow = {name: t.requires_grad_() for name, t in tensors_of(scene).items()}
    rasterize(**narrow, viewmats=viewmats, Ks=Ks, width=160, height=120)[0].backward(upstream[None])
    print(
        "\ngradients against float64's at 160x120, relative, by Gaussian (left out: "
        f"{int((~clear).sum())} of {clear.numel()} pixels within 1e-3 of a threshold):"
    )
    for name in wide:
        got, want = (x.grad.reshape(len(scene), -1).double() for x in (narrow[name], wide[name]))
        size = want.norm(dim=1)
        # The rest have gradients of rounding alone: the isotropic Gaussians' turn nothing.
        large = size > 1e-6 * size.max().clamp(min=1e-3)
        error = ((got - want).norm(dim=1) / size)[large]
        if len(error):
            p50, p99 = np.quantile(error.numpy(), (0.5, 0.99))
            print(f"  {name}: median {p50:.1e}, p99 {p99:.1e}, of {len(error):,}")


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(machine())
    scene, X_WC = load_scene(COUNTS[0])
    width, height = 320, 240
    calls = step_calls(scene, X_WC, (width, height), "", 1)
    if Path("/proc/self/clear_refs").exists():
        print("peak of resident memory above what it was, first call at 320x240: " + ", ".join(
            f"{label} {peak_growth(call):.0f} MiB" for label, call in calls.items()))  # fmt: skip

    tensors = tensors_of(scene)
    viewmats, Ks = cameras_of(X_WC, width, height)
    reference = load_reference()
    view = {"viewmat": viewmats[0], "K": Ks[0], "width": width, "height": height}
    start = time.perf_counter()
    reference.render(**tensors, **view, dtype=torch.float32)
    middle = time.perf_counter()
    leaves = {name: t.clone().requires_grad_() for name, t in tensors.items()}
    reference.render(**leaves, **view, dtype=torch.float32).color.sum().backward()
    reference_ms = (1e3 * (middle - start), 1e3 * (time.perf_counter() - middle))
    ours = [milliseconds(calls[label])[0] for label in ("forward", "+ backward")]
    expected = reference.render(**tensors, **view)
    image, alpha, meta = rasterize(
        **tensors, viewmats=viewmats, Ks=Ks, width=width, height=height, render_mode="RGB+D"
    )
    name = "TartanAir hospital" if "FLYSPLAT_DATA" in os.environ else "synthetic room"
    print(
        f"{name}: {len(scene):,} Gaussians, {len(meta['gaussian_ids']):,} visible at 320x240, mean "
        f"alpha {alpha.mean():.3f}\nvectorised torch reference (float32, one thread) at 320x240: "
        f"forward {reference_ms[0]:.0f} ms ({reference_ms[0] / ours[0]:.0f} times ours), with "
        f"backward {reference_ms[1]:.0f} ms ({reference_ms[1] / ours[1]:.0f} times ours)\n"
    )
    print_steps()
    print_baked(scene, X_WC)
    print_share_of_limit(scene, X_WC)

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
    print_gradient_agreement(scene, X_WC, reference)


if __name__ == "__main__":
    main()
