"""Adding and removing Gaussians where images ask for it: the strategy of 3D Gaussian splatting.

Kerbl et al. 2023, section 5.2: Gaussians whose place on the image has a large gradient are doubled
if small and split if large, faint and huge ones are removed, and opacities are reset now and then,
so that what is not needed fades.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.quaternions import rotate
from splatpilot.training.reconstruction.splat_parameters import SplatParameters
from splatpilot.training.reconstruction.splat_rendering import Rendering

# Relative to the extent of the scene or, farther out, to the distance from its centre.
_SMALL = 0.01
_HUGE = 0.1
_SPLIT_SHRINK = 1.6


class DefaultStrategy:
    """Gathers gradients, and acts upon them every so many steps.

    Args:
        config: thresholds and times.
        center: (3,) [m], and
        extent: [m], of the cameras.
        count: of the Gaussians.
    """

    def __init__(self, config: ReconstructConfig, center: Tensor, extent: float, count: int):
        self._config = config
        self._center, self._extent = center, extent
        self._clear(count, center.device)

    def watch(self, rendering: Rendering) -> None:
        """Has the coming backward pass keep the gradients of places on the image."""
        if self._config.representation == "3dgs":
            rendering.meta["means2d"].retain_grad()

    @torch.no_grad()
    def observe(
        self, rendering: Rendering, splats: SplatParameters, viewmat: Tensor, K: Tensor
    ) -> None:
        """Adds up the gradients of a backward pass, in half widths and heights of the image."""
        meta = rendering.meta
        rows, means2d = meta["gaussian_ids"], meta["means2d"]
        if self._config.representation == "3dgs":
            gradient = means2d.absgrad if self._config.absgrad else means2d.grad
        else:
            # Surfels: u = f x / z, so that dL/du is about z / f dL/dx with x in the camera.
            by_means = splats["means"].grad
            assert by_means is not None
            gradient = (by_means[rows] @ viewmat[0, :3, :3].T)[:, :2]
            gradient = gradient * (meta["depths"][:, None] / K[0, [0, 1], [0, 1]])
        half = gradient.new_tensor([meta["width"] / 2, meta["height"] / 2])
        self.gradients.index_add_(0, rows, (gradient * half).norm(dim=1))
        self.counts.index_add_(0, rows, torch.ones_like(rows, dtype=torch.float32))

    @torch.no_grad()
    def refine(self, step: int, splats: SplatParameters, rates: Mapping[str, float]) -> None:
        """Changes the Gaussians if it is time to, after step number `step` (from 1)."""
        config = self._config
        if step > config.refine_fraction * config.iterations:
            return
        if step >= config.refine_start and step % config.refine_every == 0:
            self._grow(splats, torch.Generator().manual_seed(config.seed * 1_000_003 + step))
            self._prune(splats, huge=config.reset_every > 0 and step > config.reset_every)
            self._clear(len(splats), splats["means"].device)
        if config.reset_every and step % config.reset_every == 0:
            dim = torch.logit(torch.tensor(2 * config.prune_opacity)).item()
            splats.overwrite("logit_opacities", splats["logit_opacities"].clamp(max=dim))

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint keeps."""
        return {"gradients": self.gradients, "counts": self.counts}

    def restore(self, state: dict[str, Tensor]) -> None:
        self.gradients, self.counts = state["gradients"], state["counts"]

    def _clear(self, count: int, device: torch.device) -> None:
        self.gradients = torch.zeros(count, device=device)
        self.counts = torch.zeros(count, device=device)

    def _reach(self, means: Tensor) -> Tensor:
        return (means - self._center).norm(dim=1).clamp(min=self._extent)  # (N,) [m]

    def _grow(self, splats: SplatParameters, generator: torch.Generator) -> None:
        config = self._config
        gradient = self.gradients / self.counts.clamp(min=1)
        grow = gradient > config.grow_gradient
        room = max(config.max_gaussians - len(splats), 0)
        if grow.sum() > room:
            strongest = torch.sort(gradient, descending=True, stable=True).indices[:room]
            grow = torch.zeros_like(grow).index_fill(0, strongest, True)
        large = splats.scales.max(dim=1).values > _SMALL * self._reach(splats["means"])
        double = torch.nonzero(grow & ~large)[:, 0]
        split = torch.nonzero(grow & large)[:, 0].repeat(2)

        added = {n: splats[n][torch.cat([double, split])].clone() for n in splats.names}
        parts = slice(len(double), None)
        random = torch.randn((len(split), 3), generator=generator).to(splats["means"].device)
        offset = random * splats.scales[split]
        added["means"][parts] += rotate(splats["quats"][split], offset)
        added["log_scales"][parts] -= torch.log(torch.tensor(_SPLIT_SHRINK))
        splats.rebuild(torch.nonzero(~(grow & large))[:, 0], added)

    def _prune(self, splats: SplatParameters, huge: bool) -> None:
        bad = splats.opacities < self._config.prune_opacity
        if huge:
            bad |= splats.scales.max(dim=1).values > _HUGE * self._reach(splats["means"])
        splats.rebuild(torch.nonzero(~bad)[:, 0])
