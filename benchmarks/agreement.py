"""How closely the CPU renderer agrees with the float64 reference, and gsplat's CUDA with both.

    python benchmarks/agreement.py

On the benchmark's scene, and with SPLATPILOT_DATA set on gsplat's own test scene, the garden, for
which scales, orientations and opacities are drawn at random as gsplat's tests do. The comparison
with gsplat's CUDA kernels says why it is skipped where there is no GPU or no gsplat.
"""

import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import header, machine, row
from pydrake.math import RigidTransform
from scenes import cameras_of, load_scene, scene_name, tensors_of
from torch import Tensor

from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels

sys.path.append(str(Path(__file__).parents[1] / "tests/systems/splats"))


def load_reference() -> Any:
    return importlib.import_module("reference_rasterizer")


def print_errors(label: str, got: Tensor, want: Tensor, clear: Tensor) -> None:
    """Absolute errors of pixels, those within rounding of a threshold counted apart."""
    error = (got.double() - want.double()).abs()
    p99 = float(np.quantile(error[clear].cpu().numpy(), 0.99))
    least = float(error[~clear].max()) if bool((~clear).any()) else 0.0
    row(
        label, f"{error[clear].median():.1e}", f"{p99:.1e}", f"{error[clear].max():.1e}",
        f"{int((~clear).sum())} of {clear.numel()}", f"{least:.1e}",
    )  # fmt: skip


def print_image_agreement(scene: GaussianScene, X_WC: RigidTransform, reference: Any) -> None:
    tensors = tensors_of(scene)
    viewmats, Ks = cameras_of(X_WC, 320, 240)
    view: dict[str, Any] = {"viewmat": viewmats[0], "K": Ks[0], "width": 320, "height": 240}
    expected = reference.render(**tensors, **view)
    image, alpha, meta = rasterize(
        **tensors, viewmats=viewmats, Ks=Ks, width=320, height=240, render_mode="RGB+D"
    )
    header(
        f"{scene_name()}, 320x240, against float64", "median", "p99", "max",
        "pixels within 1e-4 of a threshold", "max there",
    )  # fmt: skip
    clear = expected.margin > 1e-4
    print_errors("colour", image[0, ..., :3], expected.color, clear)
    print_errors("accumulated depth [m]", image[0, ..., 3], expected.depth, clear)
    print_errors("alpha", alpha[0, ..., 0], expected.alpha, clear)
    # Where float32 cannot tell depths apart, blending in its order tells rounding from mistakes.
    depths = torch.full((len(scene),), torch.inf).index_copy(
        0, meta["gaussian_ids"], meta["depths"]
    )
    expected = reference.render(**tensors, **view, blend_order=depths)
    print_errors("colour, in float32's order", image[0, ..., :3], expected.color, clear)


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
        f"\npixels within 1e-3 of a threshold, left out: {int((~clear).sum())} of {clear.numel()}"
    )
    header("gradients at 160x120, relative, by Gaussian", "median", "p99", "Gaussians")
    for name in wide:
        got, want = (x.grad.reshape(len(scene), -1).double() for x in (narrow[name], wide[name]))
        size = want.norm(dim=1)
        # The rest have gradients of rounding alone: the isotropic Gaussians' turn nothing.
        large = size > 1e-6 * size.max().clamp(min=1e-3)
        error = ((got - want).norm(dim=1) / size)[large]
        if len(error):
            p50, p99 = np.quantile(error.numpy(), (0.5, 0.99))
            row(name, f"{p50:.1e}", f"{p99:.1e}", f"{len(error):,}")


def print_gsplat_agreement(scene: GaussianScene, X_WC: RigidTransform) -> None:
    """gsplat's CUDA kernels and ours: the scene at 320x240, and the garden at its full size."""
    if not torch.cuda.is_available():
        print("\ngsplat on CUDA: skipped, torch finds no GPU")
        return
    if importlib.util.find_spec("gsplat") is None:
        print("\ngsplat on CUDA: skipped, it is not installed: pip install 'splatpilot[cuda]'")
        return
    version = importlib.import_module("gsplat").__version__
    print(f"\ngsplat {version}, {torch.cuda.get_device_name()}")
    viewmats, Ks = cameras_of(X_WC, 320, 240)
    view: dict[str, Any] = {"viewmats": viewmats, "Ks": Ks, "width": 320, "height": 240}
    view["render_mode"], tensors = "RGB+ED", tensors_of(scene)
    print_devices(scene_name(), rasterize, tensors, view)
    smooth = view | {"rasterize_mode": "antialiased"}
    print_devices(f"{scene_name()}, antialiased", rasterize, tensors, smooth)
    print_devices(f"{scene_name()}, surfels", rasterize_surfels, tensors, view)
    if "SPLATPILOT_DATA" not in os.environ:
        print("\nthe garden: skipped, SPLATPILOT_DATA is not set")
        return
    garden = importlib.import_module("garden").load_garden(Path(os.environ["SPLATPILOT_DATA"]))
    view = {"viewmats": garden.viewmats, "Ks": garden.Ks, "render_mode": "RGB+D"}
    view |= {"width": garden.width, "height": garden.height}
    print_devices("garden", rasterize, garden.scene, view)


def print_devices(
    name: str, draw: Callable[..., Any], scene: dict[str, Tensor], view: dict[str, Any]
) -> None:
    """Images and gradients of one rasteriser's CPU kernels against gsplat's."""
    results = {}
    upstream: Tensor | None = None
    for device in ("cpu", "cuda"):
        leaves = {n: t.to(device).detach().requires_grad_() for n, t in scene.items()}
        there = {n: v.to(device) if isinstance(v, Tensor) else v for n, v in view.items()}
        image, alpha, *_ = draw(**leaves, **there)
        upstream = torch.randn(image.shape) if upstream is None else upstream
        image.backward(upstream.to(device))
        gradients = {n: t.grad.cpu() for n, t in leaves.items() if t.grad is not None}
        results[device] = (image.detach().cpu(), alpha.detach().cpu(), gradients)
    (ours, our_alpha, our_gradients), (theirs, their_alpha, their_gradients) = (
        results[device] for device in ("cpu", "cuda")
    )
    header(f"{name}, ours against gsplat's", "median", "p99", "max", "beyond 1e-3", "max there")
    for label, got, want in (("image", ours, theirs), ("alpha", our_alpha, their_alpha)):
        # A threshold that falls the other way changes a pixel by up to 1/255 of a colour.
        print_errors(label, got, want, (got - want).abs() <= 1e-3)
    header("gradient", "relative error of the whole", "beyond rtol 1e-5, atol 1e-3")
    for tensor, got in our_gradients.items():
        want = their_gradients[tensor]
        beyond = (got - want).abs() > 1e-3 + 1e-5 * want.abs()
        # Isotropic Gaussians turn nothing: gsplat's gradient of their orientations is 0.
        relative = f"{(got - want).norm() / want.norm():.1e}" if want.any() else "-"
        row(tensor, relative, f"{int(beyond.sum())} of {got.numel()}")


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(machine())
    scene, X_WC = load_scene(100_000)
    reference = load_reference()
    print_image_agreement(scene, X_WC, reference)
    print_gradient_agreement(scene, X_WC, reference)
    print_gsplat_agreement(scene, X_WC)


if __name__ == "__main__":
    main()
