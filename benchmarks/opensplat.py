"""OpenSplat's CPU renderer, built from the user's own checkout, against ours.

OpenSplat is licensed under the AGPL; nothing of it is part of this project. Both get the Gaussians
that are in view, one colour each. Calls take turns, so that both see the same machine, and their
times are those of the process's CPU. "raster" starts from the same projected Gaussians and includes
sorting and binning, or OpenSplat's lists of each pixel; "forward" is projection and raster without
gradients; "forward and backward" has the gradients of means, quaternions, scales, opacities and
colours, OpenSplat's projection being differentiated by torch as in its own training.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import header, row
from pydrake.math import RigidTransform
from scenes import cameras_of, tensors_of
from torch import Tensor
from torch.utils.cpp_extension import load

from splatpilot.systems.splats import rasterize
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.scene import GaussianScene

SOURCE = Path("rasterizer/gsplat-cpu/gsplat_cpu.cpp")
WIDTH, HEIGHT = 320, 240
ROUNDS = 12
NEAR, FAR = 0.01, 1e3
BINDING = """
#include <torch/extension.h>
#include "bindings.h"

using torch::Tensor;

std::vector<Tensor> project(Tensor means, Tensor scales, Tensor quats, Tensor view, Tensor proj,
                            float fx, float fy, float cx, float cy, int height, int width) {
  auto [xys, radii, conics, cov2d, depths] = project_gaussians_forward_tensor_cpu(
      means.size(0), means, scales, 1.0f, quats, view, proj, fx, fy, cx, cy, height, width, 0.01f);
  return {xys, conics, cov2d, depths};
}

std::tuple<Tensor, Tensor, int64_t> forward(int width, int height, Tensor xys, Tensor conics,
                                            Tensor colors, Tensor opacities, Tensor background,
                                            Tensor cov2d, Tensor depths) {
  auto [image, transmittance, lists] = rasterize_forward_tensor_cpu(
      width, height, xys, conics, colors, opacities, background, cov2d, depths);
  return {image, transmittance, reinterpret_cast<int64_t>(lists)};
}

std::vector<Tensor> backward(int width, int height, Tensor xys, Tensor conics, Tensor colors,
                             Tensor opacities, Tensor background, Tensor cov2d, Tensor depths,
                             Tensor transmittance, int64_t lists, Tensor v_image, Tensor v_alpha) {
  auto [v_xys, v_conics, v_colors, v_opacities] = rasterize_backward_tensor_cpu(
      height, width, xys, conics, colors, opacities, background, cov2d, depths, transmittance,
      reinterpret_cast<std::vector<int32_t>*>(lists), v_image, v_alpha);
  return {v_xys, v_conics, v_colors, v_opacities};
}

void release(int64_t lists) { delete[] reinterpret_cast<std::vector<int32_t>*>(lists); }

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  m.def("project", &project);
  m.def("forward", &forward);
  m.def("backward", &backward);
  m.def("release", &release);
}
"""


def build_opensplat(checkout: Path) -> Any:
    """The module, compiled as OpenSplat's release build is: -O3 and nothing else.

    Raises:
        FileNotFoundError: `checkout` is no checkout of OpenSplat of 2024-05 or later.
    """
    source = checkout / SOURCE
    if not source.exists():
        raise FileNotFoundError(
            f"{source} does not exist; --opensplat takes the folder that "
            "`git clone https://github.com/pierotofy/OpenSplat` makes"
        )
    with tempfile.TemporaryDirectory() as folder:
        binding = Path(folder) / "binding.cpp"
        binding.write_text(BINDING)
        return load(
            "opensplat_cpu",
            [str(binding), str(source)],
            extra_include_paths=[str(source.parent.resolve())],
            extra_cflags=["-O3", "-DNDEBUG"],
            build_directory=folder,
        )


class Theirs:
    """OpenSplat's calls on the Gaussians of one view."""

    def __init__(self, module: Any, tensors: dict[str, Tensor], view: Tensor, K: Tensor):
        self._module, self._view = module, view.contiguous()
        self._focal = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        fx, fy, cx, cy = self._focal
        ratio = FAR / (FAR - NEAR)
        projection = torch.tensor(
            [[2 * fx / WIDTH, 0, 2 * cx / WIDTH - 1, 0],
             [0, 2 * fy / HEIGHT, 2 * cy / HEIGHT - 1, 0],
             [0, 0, ratio, -NEAR * ratio],
             [0, 0, 1, 0]]
        )  # fmt: skip
        self._projection = (projection @ view).contiguous()
        self.leaves = {name: t.clone().requires_grad_() for name, t in tensors.items()}
        self._black = torch.zeros(3)

    def project(self) -> list[Tensor]:
        values = (self.leaves[name] for name in ("means", "scales", "quats"))
        return self._module.project(
            *values, self._view, self._projection, *self._focal, HEIGHT, WIDTH
        )

    def raster(self, projected: list[Tensor]) -> tuple[tuple, Tensor, Tensor, int]:
        """What it was called with, the image, what passes, and the lists, to be released."""
        xys, conics, cov2d, depths = (value.detach().contiguous() for value in projected)
        colors = self.leaves["colors"].detach().contiguous()
        opacities = self.leaves["opacities"].detach()[:, None].contiguous()
        arguments = (WIDTH, HEIGHT, xys, conics, colors, opacities, self._black, cov2d, depths)
        return arguments, *self._module.forward(*arguments)

    def image(self, projected: list[Tensor]) -> Tensor:
        _, image, _, lists = self.raster(projected)
        self._module.release(lists)
        return image

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.image(self.project())

    def step(self, v_image: Tensor) -> None:
        """Forward and backward."""
        for leaf in self.leaves.values():
            leaf.grad = None
        projected = self.project()
        arguments, _, passing, lists = self.raster(projected)
        gradients = self._module.backward(
            *arguments, passing, lists, v_image, torch.zeros(HEIGHT, WIDTH)
        )
        self._module.release(lists)
        v_xys, v_conics, v_colors, v_opacities = gradients
        torch.autograd.backward(projected[:2], [v_xys, v_conics])
        self.leaves["colors"].grad, self.leaves["opacities"].grad = v_colors, v_opacities[:, 0]


class Ours:
    """Our calls on the same."""

    def __init__(self, tensors: dict[str, Tensor], viewmats: Tensor, Ks: Tensor):
        self.leaves = {name: t.clone().requires_grad_() for name, t in tensors.items()}
        self.renderer = create_renderer(1)
        self._camera: dict[str, Any] = {"viewmats": viewmats, "Ks": Ks}
        self._camera |= {"width": WIDTH, "height": HEIGHT, "renderer": self.renderer}

    def forward(self) -> Tensor:
        with torch.no_grad():
            return rasterize(**self.leaves, **self._camera)[0][0]

    def step(self, v_image: Tensor) -> None:
        for leaf in self.leaves.values():
            leaf.grad = None
        rasterize(**self.leaves, **self._camera)[0].backward(v_image[None])

    def raster_seconds(self) -> float:
        """Sorting, binning and raster of the last image."""
        return sum(s for stage, s in self.renderer.seconds.items() if stage != "project")


def print_opensplat(scene: GaussianScene, X_WC: RigidTransform, checkout: Path) -> None:
    """One thread, in turns."""
    module = build_opensplat(checkout)
    viewmats, Ks = cameras_of(X_WC, WIDTH, HEIGHT)
    tensors = tensors_of(scene)
    _, _, meta = rasterize(**tensors, viewmats=viewmats, Ks=Ks, width=WIDTH, height=HEIGHT)
    seen = {name: value[meta["gaussian_ids"]].contiguous() for name, value in tensors.items()}
    theirs, ours = Theirs(module, seen, viewmats[0], Ks[0]), Ours(seen, viewmats, Ks)
    v_image = torch.randn(HEIGHT, WIDTH, 3)
    with torch.no_grad():
        projected = theirs.project()
    calls: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "raster": (lambda: theirs.image(projected), ours.forward),
        "forward": (theirs.forward, ours.forward),
        "forward and backward": (lambda: theirs.step(v_image), lambda: ours.step(v_image)),
    }
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    header(f"OpenSplat, {len(seen['means']):,} in view, one thread [ms]", "theirs", "ours", "ratio")
    for name, (their_call, our_call) in calls.items():
        timed = ours.raster_seconds if name == "raster" else None
        pairs = np.array([_pair(their_call, our_call, timed) for _ in range(ROUNDS + 1)][1:])
        ratio = pairs[:, 0] / pairs[:, 1]
        cells = [f"{1e3 * np.median(column):.2f}" for column in pairs.T]
        row(name, *cells, f"{np.median(ratio):.0f} ({ratio.min():.0f} to {ratio.max():.0f})")
    torch.set_num_threads(threads)
    difference = float((theirs.forward() - ours.forward()).abs().median())
    theirs.step(v_image)
    ours.step(v_image)
    errors = ", ".join(f"{n} {_difference(theirs, ours, n):.1e}" for n in ours.leaves)
    print(f"median difference of the images {difference:.1e}; of the gradients: {errors}")


def _difference(theirs: Theirs, ours: Ours, name: str) -> float:
    """Between the gradients, relative to ours."""
    a, b = theirs.leaves[name].grad, ours.leaves[name].grad
    assert a is not None and b is not None
    return float((a - b).norm() / b.norm())


def _pair(
    theirs: Callable[[], object],
    ours: Callable[[], object],
    stages: Callable[[], float] | None,
) -> tuple[float, float]:
    """CPU seconds of a call of each, ours the mean of ten; or of `stages` of ours."""
    start = time.process_time()
    theirs()
    middle = time.process_time()
    if stages is not None:
        return middle - start, float(np.mean([(ours(), stages())[1] for _ in range(10)]))
    for _ in range(10):
        ours()
    return middle - start, (time.process_time() - middle) / 10
