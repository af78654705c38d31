"""What each step of a reconstruction minimises: equations 1 and 2 of the paper, and what holds
Gaussians to the surfaces that depth shows."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.losses import log_depth_loss, photometric_loss
from splatpilot.training.reconstruction.splat_rendering import Rendering
from splatpilot.training.reconstruction.surface_loss import outline_loss, surface_loss
from splatpilot.training.reconstruction.views import ReconstructionViews

# Part of the Gaussians in view that are held to their surfaces in a step.
_HELD = 1 / 4
# Terms of 2D Gaussian splatting begin after these parts of all steps, as in its publication.
_DISTORTION_START, _NORMAL_START = 0.1, 7 / 30


class Objective:
    """The loss of one view, with the weights of `config`.

    Args:
        config: how.
        views: the truth.
        perceptual: LPIPS of two images (H, W, 3), or None.
    """

    def __init__(
        self,
        config: ReconstructConfig,
        views: ReconstructionViews,
        perceptual: Callable[[Tensor, Tensor], Tensor] | None,
    ):
        self._config, self._views, self._perceptual = config, views, perceptual

    def wants_distortion(self, step: int) -> bool:
        """Returns whether surfels are to render the spread along their rays in this step."""
        config = self._config
        late = step >= _DISTORTION_START * config.iterations
        return config.representation == "2dgs" and config.distortion_weight > 0 and late

    def loss(
        self,
        rendering: Rendering,
        gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
        k: int,
        gain: Tensor,
        step: int,
        backdrop: Tensor,
        outlines: bool,
    ) -> Tensor:
        """Returns a scalar.

        Args:
            rendering: of view `k`, before `backdrop`.
            gaussians: what was rendered: means, quats, scales, opacities, spherical harmonics.
            k: number of the view.
            gain: brightness of its image.
            step: of all, from which what is random follows.
            backdrop: (1, 3), a colour.
            outlines: fits these in place of colours.
        """
        config, device = self._config, self._config.device
        depth = self._views.depths[k].to(device)
        edges = self._views.edges[k].to(device).float()
        if outlines:
            loss = config.outline_weight * outline_loss(rendering.alpha, depth, edges)
        else:
            target = self._views.target(k, gain, backdrop.cpu()[0]).to(device)
            valid = self._views.valid[k].to(device)[..., None]
            color, invalid = rendering.color, rendering.color.detach()
            # Both are the same where pixels are invalid, so that windows compare nothing there.
            color, target = (torch.where(valid, image, invalid) for image in (color, target))
            loss = self._color_loss(color, target, step)
        if config.depth_weight > 0:
            loss = loss + config.depth_weight * log_depth_loss(rendering.depth, depth, edges)
        if config.surface_weight > 0:
            rng = np.random.default_rng([config.seed, step, 2])
            seen = rendering.meta["gaussian_ids"]
            seen = seen[torch.from_numpy(rng.random(len(seen)) < _HELD).to(device)]
            viewmat, K = self._views.camera(k, device)
            on_surface = surface_loss(*gaussians[:3], seen, viewmat[0], K[0], depth, rng)
            loss = loss + config.surface_weight * on_surface
        return loss + self._surfel_loss(rendering, step)

    def _color_loss(self, color: Tensor, target: Tensor, step: int) -> Tensor:
        config = self._config
        loss = photometric_loss(color, target, config.ssim_weight)
        late = step >= (1 - config.lpips_fraction) * config.iterations
        if self._perceptual is not None and late and step % config.lpips_every == 0:
            weight = config.lpips_weight * config.lpips_every
            loss = loss + weight * self._perceptual(color.clamp(0, 1), target.clamp(0, 1))
        return loss

    def _surfel_loss(self, rendering: Rendering, step: int) -> Tensor | float:
        """The terms of 2D Gaussian splatting: the spread along rays, and how far normals are from
        those of the surface they make; 0 for Gaussians."""
        config = self._config
        if rendering.normals is None or rendering.surface_normals is None:
            return 0.0
        loss: Tensor | float = 0.0
        if self.wants_distortion(step) and rendering.distortion is not None:
            loss = loss + config.distortion_weight * rendering.distortion.mean()
        if config.normal_weight > 0 and step >= _NORMAL_START * config.iterations:
            surface = rendering.surface_normals * rendering.alpha.detach()[..., None]
            cosine = (rendering.normals * surface).sum(dim=-1)
            loss = loss + config.normal_weight * (1 - cosine).mean()
        return loss
