"""Rendering of Gaussians ("3dgs") or surfels ("2dgs") for reconstruction."""

from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from torch import Tensor

from splatpilot._native import Renderer
from splatpilot.systems.splats.background import RenderedView
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.rasterization import EPS2D, rasterize
from splatpilot.systems.splats.scene import GaussianScene, harmonic_degree
from splatpilot.systems.splats.surfel_rasterization import rasterize_surfels


@dataclass(frozen=True)
class Rendering:
    """One camera's images."""

    color: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) [m], accumulated, expected or median
    alpha: Tensor  # (H, W)
    meta: dict[str, Any]  # of the rasterizer
    normals: Tensor | None = None  # (H, W, 3) sum of weight and normal; surfels only
    surface_normals: Tensor | None = None  # (H, W, 3) from depth; surfels only
    distortion: Tensor | None = None  # (H, W) [m]; surfels only, if requested

    def view(self) -> RenderedView:
        return RenderedView(*(image.numpy() for image in (self.color, self.depth, self.alpha)))


def render(
    representation: str,
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    depth_mode: str = "D",
    eps2d: float = EPS2D,
    distortion: bool = False,
    renderer: Renderer | None = None,
) -> Rendering:
    """Renders color and depth of one camera, see `rasterize` for the arguments; `gaussians` are
    means, quats, scales, opacities and spherical harmonics. `depth_mode` is "D", accumulated, "ED",
    expected, or "MD", median, which has no gradient and is 0 without a surface. `eps2d` blurs
    Gaussians, not surfels; `distortion` renders that of surfels along their rays."""
    scene = *gaussians, viewmat, K, width, height
    options: dict[str, Any] = {
        "sh_degree": harmonic_degree(gaussians[4].shape[1]),
        "backgrounds": background,
        "renderer": renderer,
    }
    if representation == "3dgs":
        image, alpha, meta = rasterize(
            *scene, **options, render_mode=f"RGB+{depth_mode}", eps2d=eps2d
        )
        color, depth = image[0].split((3, 1), dim=-1)
        return Rendering(color, depth.reshape(height, width), alpha.reshape(height, width), meta)
    is_median = depth_mode == "MD"
    image, alpha, normals, surface_normals, distort, median, meta = rasterize_surfels(
        *scene,
        **options,
        render_mode="RGB+ED" if is_median else f"RGB+{depth_mode}",
        distloss=distortion,
    )
    surface = torch.where(alpha >= 0.5, median, 0)[0, ..., 0]
    return Rendering(
        image[0, ..., :3],
        surface if is_median else image[0, ..., 3],
        alpha[0, ..., 0],
        meta,
        normals[0],
        None if surface_normals is None else surface_normals[0],
        distort[0, ..., 0],
    )


class SceneRenderer:
    """Renders a static scene."""

    def __init__(self, scene: GaussianScene, representation: str, threads: int = 1):
        self._renderer = create_renderer(threads)
        self._baked = BakedScene(scene, threads) if representation == "3dgs" else None
        arrays = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
        means, quats, scales, opacities, sh = map(torch.from_numpy, arrays)
        self._tensors = (means, quats, scales, opacities, sh)

    @torch.no_grad()
    def render(self, K: NDArray, width: int, height: int, X_WC: RigidTransform) -> RenderedView:
        """Renders color on black, median depth and alpha; see `BakedScene.render`."""
        if self._baked is not None:
            return self._baked.render(K, width, height, X_WC)
        viewmat = torch.tensor(X_WC.inverse().GetAsMatrix4(), dtype=torch.float32)[None]
        camera = viewmat, torch.tensor(K, dtype=torch.float32)[None], width, height
        rendering = render("2dgs", self._tensors, *camera, depth_mode="MD", renderer=self._renderer)
        return rendering.view()
