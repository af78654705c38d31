"""The raster kernels alone, against OpenSplat's and against the machine's own limits."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import header, milliseconds, row
from opensplat import print_opensplat
from pydrake.math import RigidTransform
from scenes import cameras_of, tensors_of

from splatpilot import _native
from splatpilot.systems.splats.scene import GaussianScene

WIDTH, HEIGHT = 320, 240
# Vector instructions of the backward pass in the inner loops of native/backward, counted
# by hand for RGB: a (Gaussian, 4x4 block) composited again and differentiated, and one reduction.
VECTOR_WORK = {"block": 45, "pair": 40}
FMA_ROUNDS = 200_000
BYTES_PER_PAIR = 64 + 8  # read by the forward kernel: a Splat, and its entry in the tile's list
COPY_FLOATS = 1 << 25  # 128 MiB, beyond every cache


class Kernel:
    """A native renderer with the scene as it wants it, RGB."""

    def __init__(self, scene: GaussianScene, X_WC: RigidTransform, simd: str):
        tensors = tensors_of(scene)
        viewmats, Ks = cameras_of(X_WC, WIDTH, HEIGHT)
        self.renderer = _native.Renderer(1, simd)
        self._arguments: dict[str, Any] = {
            name: tensors[name].numpy() for name in ("means", "quats", "scales", "opacities")
        }
        self._image, self._alpha = (np.zeros((HEIGHT, WIDTH, n), np.float32) for n in (3, 1))
        self._black = np.zeros(3, np.float32)
        self._arguments |= {
            "colors": tensors["colors"].numpy()[:, None], "sh_degree": -1,
            "K": Ks[0].double().numpy(), "X_CW": viewmats[0].double().numpy(),
            "width": WIDTH, "height": HEIGHT, "near_plane": 0.01, "far_plane": 1e10,
            "radius_clip": 0.0, "eps2d": 0.3, "antialiased": False,
            "depth_mode": _native.DepthMode.ACCUMULATED,
            "background": self._black, "image": self._image, "alpha": self._alpha, "keep": True,
        }  # fmt: skip

    def render(self) -> _native.Frame:
        return _native.render(self.renderer, **self._arguments)

    def raster_ms(self, repeats: int = 60) -> float:
        """Least milliseconds of the forward raster kernel alone, all tiles."""
        least = np.inf
        for _ in range(repeats):
            self.render()
            least = min(least, 1e3 * self.renderer.seconds["raster"])
        return float(least)

    def backward(self) -> tuple[float, int]:
        """Least milliseconds of the backward raster kernel, and (Gaussian, block) composited."""
        frame = self.render()
        gradients = np.zeros((frame.splat_count, 16), np.float32)
        means2d = np.zeros((frame.splat_count, 2), np.float32)
        least, blocks = np.inf, 0
        for _ in range(60):
            blocks = _native.raster_backward(
                self.renderer, frame, v_image=np.ones_like(self._image),
                v_alpha=np.ones_like(self._alpha), image=self._image, alpha=self._alpha,
                background=self._black, expected_depth=False, absolute=False,
                v_splats=gradients, v_means2d=means2d,
            )  # fmt: skip
            least = min(least, 1e3 * self.renderer.seconds["raster backward"])
        return float(least), blocks


def print_raster_kernel(scene: GaussianScene, X_WC: RigidTransform, opensplat: Path | None) -> None:
    header("forward raster kernel, 320x240, one thread", "ms")
    ours = {simd: Kernel(scene, X_WC, simd).raster_ms() for simd in _native.simd_levels()}
    for simd, ms in ours.items():
        row(f"splatpilot {simd}", f"{ms:.3f}")
    if opensplat is None:
        print("OpenSplat: not measured; name a checkout with --opensplat")
    else:
        print_opensplat(scene, X_WC, opensplat)


def copy_rate() -> float:
    """GB/s read and written by copying 128 MiB on one thread."""
    source, target = torch.ones(COPY_FLOATS), torch.empty(COPY_FLOATS)
    least, _ = milliseconds(lambda: target.copy_(source), 10)
    return 2 * 4 * COPY_FLOATS / least / 1e6


def print_limits(scene: GaussianScene, X_WC: RigidTransform) -> None:
    """The raster kernels against independent multiply-adds and against a copy's bandwidth."""
    bandwidth = copy_rate()
    print(f"\ncopying 128 MiB on one thread: {bandwidth:.1f} GB/s")
    header(
        "SIMD", "G multiply-adds/s", "blocks", "pairs", "backward kernel, ms", "of multiply-adds",
        "forward kernel reads, GB/s", "of bandwidth",
    )  # fmt: skip
    for simd in _native.simd_levels():
        kernel = Kernel(scene, X_WC, simd)
        burst: Any = lambda r=kernel.renderer: _native.multiply_add(r, FMA_ROUNDS)  # noqa: E731
        least, _ = milliseconds(burst, 10)
        rate = burst()[1] / least  # lanes per ms
        forward = kernel.raster_ms()
        backward, blocks = kernel.backward()
        pairs = kernel.render().pair_count
        work = 16 * (VECTOR_WORK["block"] * blocks + VECTOR_WORK["pair"] * pairs)
        read = BYTES_PER_PAIR * pairs / forward / 1e6
        row(
            simd, f"{rate / 1e6:.0f}", f"{blocks:,}", f"{pairs:,}", f"{backward:.2f}",
            f"{work / rate / backward:.0%}", f"{read:.1f}", f"{read / bandwidth:.0%}",
        )  # fmt: skip
