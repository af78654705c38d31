"""OpenSplat's CPU rasteriser, built from the user's own checkout and called on our projection.

OpenSplat is licensed under the AGPL; nothing of it is part of this project. Its
`rasterize_forward_tensor_cpu` sorts by depth and composites, as our raster kernel does after
sorting and binning; both get the same projected Gaussians.
"""

import tempfile
from pathlib import Path
from typing import Any

import torch
from harness import milliseconds
from torch import Tensor
from torch.utils.cpp_extension import load

SOURCE = Path("rasterizer/gsplat-cpu/gsplat_cpu.cpp")
BINDING = """
#include <torch/extension.h>
#include "bindings.h"

torch::Tensor render(int width, int height, torch::Tensor means, torch::Tensor conics,
                     torch::Tensor colors, torch::Tensor opacities, torch::Tensor background,
                     torch::Tensor covariances, torch::Tensor depths) {
  auto [image, transmittance, lists] = rasterize_forward_tensor_cpu(
      width, height, means, conics, colors, opacities, background, covariances, depths);
  delete[] lists;
  return image;
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) { m.def("render", &render); }
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


def time_opensplat(
    module: Any, meta: dict[str, Any], colors: Tensor, image: Tensor
) -> tuple[float, float]:
    """Least milliseconds, and the median absolute difference from our `image` (H, W, 3)."""
    a, b, c = meta["conics"].unbind(-1)
    covariances = torch.stack([c, -b, -b, a], -1) / (a * c - b * b)[:, None]
    arguments = (
        meta["width"], meta["height"],
        meta["means2d"].detach() - 0.5,  # its pixel centres lie at whole numbers
        meta["conics"], colors.contiguous(), meta["opacities"][:, None].contiguous(),
        torch.zeros(3), covariances.reshape(-1, 2, 2), meta["depths"],
    )  # fmt: skip
    least, _ = milliseconds(lambda: module.render(*arguments), 10)
    return least, float((module.render(*arguments) - image).abs().median())
