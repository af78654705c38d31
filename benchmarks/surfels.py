"""Times the surfel renderer, forward and backward, beside the forward pass of 3D Gaussians.

    python benchmarks/surfels.py

The scene is that of benchmarks/rasterize.py, each point a disc that faces in a random direction.
The loss is a sum over colour, depth, normals and, where it is named, distortion. Times are CPU
milliseconds of whole calls on torch tensors; on a busy machine the minimum is what to read.
"""

from collections.abc import Callable

import torch
from harness import header, machine, milliseconds, row
from scenes import cameras_of, load_scene, tensors_of

from splatpilot import _native
from splatpilot._native import Renderer
from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels

COUNT = 100_000  # surfels


def show(call: Callable[[], object]) -> str:
    least, median = milliseconds(call)
    return f"{least:.2f} ({median:.2f})"


def main() -> None:
    torch.set_num_threads(1)
    scene, X_WC = load_scene(COUNT)
    surfels = tensors_of(scene)
    surfels["quats"] = torch.randn(len(scene), 4, generator=torch.Generator().manual_seed(0))
    print(f"{machine()}\n{len(scene):,} surfels, one thread; milliseconds, minimum (median)")
    header("size", "SIMD", "3D forward", "forward", "forward + backward", "with distortion")
    for width, height in ((160, 120), (320, 240), (640, 480)):
        viewmats, Ks = cameras_of(X_WC, width, height)
        view = {"viewmats": viewmats, "Ks": Ks, "width": width, "height": height}
        for level in _native.simd_levels():
            renderer = create_renderer(1, level)
            learned = {k: v.clone().requires_grad_() for k, v in surfels.items()}

            def forward_3d(renderer: Renderer = renderer, view: dict = view) -> object:
                return rasterize(**surfels, **view, renderer=renderer, render_mode="RGB+D")

            def forward(
                renderer: Renderer = renderer, view: dict = view, mode: str = "RGB"
            ) -> object:
                return rasterize_surfels(**surfels, **view, renderer=renderer, render_mode=mode)

            def both(
                distort: bool = False,
                renderer: Renderer = renderer,
                view: dict = view,
                learned: dict[str, torch.Tensor] = learned,
            ) -> None:
                image, _, normal, _, distortion, _, _ = rasterize_surfels(
                    **learned, **view, renderer=renderer, render_mode="RGB+D", distloss=distort
                )
                loss = image.sum() + normal.sum()
                (loss + distortion.sum() if distort else loss).backward()
                for tensor in learned.values():
                    tensor.grad = None

            cells = [show(call) for call in (forward_3d, forward, both, lambda f=both: f(True))]
            row(f"{width}x{height}", level, *cells)


if __name__ == "__main__":
    main()
