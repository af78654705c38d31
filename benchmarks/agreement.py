"""Compares images and gradients of the CPU renderer with gsplat's CUDA kernels; needs a GPU.

python benchmarks/agreement.py
"""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from harness import camera_tensors, header, load_scene, row, scene_name, scene_tensors
from torch import Tensor

from splatpilot.analysis.headlines import machine
from splatpilot.systems.splats import rasterize, rasterize_surfels


def print_devices(
    name: str, draw: Callable[..., Any], scene: dict[str, Tensor], view: dict[str, Any]
) -> None:
    """Prints the errors of one rasterizer's CPU kernels against gsplat's."""
    results = {}
    upstream: Tensor | None = None
    for device in ("cpu", "cuda"):
        leaves = {n: t.to(device).detach().requires_grad_() for n, t in scene.items()}
        moved = {n: v.to(device) if isinstance(v, Tensor) else v for n, v in view.items()}
        image, alpha, *_ = draw(**leaves, **moved)
        upstream = torch.randn(image.shape) if upstream is None else upstream
        image.backward(upstream.to(device))
        gradients = {n: t.grad.cpu() for n, t in leaves.items() if t.grad is not None}
        results[device] = {"image": image.detach().cpu(), "alpha": alpha.detach().cpu()}, gradients
    (ours, our_gradients), (theirs, their_gradients) = results["cpu"], results["cuda"]
    header(f"{name}, ours against gsplat's", "median", "p99", "max", "beyond 1e-3", "max there")
    for label, got in ours.items():
        error = (got - theirs[label]).abs()
        # A threshold that only one of them passes changes a pixel by up to 1/255 of a color.
        clear = error <= 1e-3
        p99 = float(np.quantile(error[clear].numpy(), 0.99))
        flipped = float(error[~clear].max()) if bool((~clear).any()) else 0.0
        row(
            label, f"{error[clear].median():.1e}", f"{p99:.1e}", f"{error[clear].max():.1e}",
            f"{int((~clear).sum())} of {clear.numel()}", f"{flipped:.1e}",
        )  # fmt: skip
    header("gradient", "relative error of all", "beyond rtol 1e-5, atol 1e-3")
    for tensor, got in our_gradients.items():
        expected = their_gradients[tensor]
        beyond = (got - expected).abs() > 1e-3 + 1e-5 * expected.abs()
        # gsplat's gradient of the orientations of isotropic Gaussians is 0.
        relative = f"{(got - expected).norm() / expected.norm():.1e}" if expected.any() else "-"
        row(tensor, relative, f"{int(beyond.sum())} of {got.numel()}")


def main() -> None:
    print(machine())
    if not torch.cuda.is_available():
        print("skipped: torch finds no GPU")
        return
    gsplat = importlib.import_module("gsplat")
    print(f"gsplat {gsplat.__version__}, {torch.cuda.get_device_name()}")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    scene, X_WC = load_scene(100_000)
    viewmats, Ks = camera_tensors(X_WC, 320, 240)
    view: dict[str, Any] = {"viewmats": viewmats, "Ks": Ks, "width": 320, "height": 240}
    view["render_mode"], tensors = "RGB+ED", scene_tensors(scene)
    print_devices(scene_name(), rasterize, tensors, view)
    smooth = view | {"rasterize_mode": "antialiased"}
    print_devices(f"{scene_name()}, antialiased", rasterize, tensors, smooth)
    print_devices(f"{scene_name()}, surfels", rasterize_surfels, tensors, view)


if __name__ == "__main__":
    main()
