"""Gaussians as samples: relocation and noise in place of cloning and splitting.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.parameters import SplatParameters
from splatpilot.training.reconstruction.quaternions import rotate
from splatpilot.training.reconstruction.splat_rendering import Rendering

# Most Gaussians that one may become.
_MOST = 51
_GROWTH = 1.05
# Noise is for faint Gaussians: it is damped by a logistic function of opacity about this one.
_NOISE_OPACITY, _NOISE_STEEPNESS = 0.005, 100.0
# Weights of the mean opacity and of the mean scale [1/m] in the loss.
_OPACITY_PENALTY, _SCALE_PENALTY = 0.01, 0.01


class McmcStrategy:
    """Moves dead Gaussians to living ones, adds some up to the limit, and shakes them all."""

    def __init__(self, config: ReconstructConfig):
        self._config = config

    def watch(self, rendering: Rendering) -> None:
        """Needs nothing of the rendering."""

    def observe(
        self, rendering: Rendering, splats: SplatParameters, viewmat: Tensor, K: Tensor
    ) -> None:
        """Needs nothing of the gradients."""

    @torch.no_grad()
    def refine(self, step: int, splats: SplatParameters, rates: Mapping[str, float]) -> None:
        """Changes the Gaussians after step number `step` (from 1), which had these learning
        rates."""
        config = self._config
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
        is_time = step >= config.refine_start and step % config.refine_every == 0
        if is_time and step <= config.refine_fraction * config.iterations:
            self._relocate(splats, generator)
            wanted = min(int(_GROWTH * len(splats)), config.max_gaussians)
            self._add(splats, wanted - len(splats), generator)
        damping = torch.sigmoid(-_NOISE_STEEPNESS * (splats.opacities - _NOISE_OPACITY))
        noise = torch.randn((len(splats), 3), generator=generator).to(splats["means"].device)
        noise *= (config.noise * rates["means"] * damping)[:, None]
        # Covariance times noise, in the Gaussian's own axes.
        q = splats["quats"]
        inverse = q * q.new_tensor([1.0, -1.0, -1.0, -1.0])
        splats["means"].add_(rotate(q, splats.scales**2 * rotate(inverse, noise)))

    def state(self) -> dict[str, Tensor]:
        """Nothing: all random numbers follow from the step."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        pass

    def _relocate(self, splats: SplatParameters, generator: torch.Generator) -> None:
        dead = splats.opacities <= self._config.prune_opacity
        living = torch.nonzero(~dead)[:, 0]
        if dead.any() and len(living):
            chosen = _sample(splats, living, int(dead.sum()), generator)
            _share(splats, chosen)
            added = {name: splats[name][chosen] for name in splats.names}
            splats.rebuild(living, added)

    def _add(self, splats: SplatParameters, count: int, generator: torch.Generator) -> None:
        if count > 0:
            everyone = torch.arange(len(splats), device=splats["means"].device)
            chosen = _sample(splats, everyone, count, generator)
            _share(splats, chosen)
            splats.rebuild(everyone, {name: splats[name][chosen] for name in splats.names})


def penalty(splats: SplatParameters) -> Tensor:
    """Returns what the loss adds for opacity and size, by which Gaussians that do nothing die."""
    return _OPACITY_PENALTY * splats.opacities.mean() + _SCALE_PENALTY * splats.scales.mean()


def share_out(opacities: Tensor, scales: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Returns opacities (N,) and scales (N, 3) with which `counts` (N,) Gaussians in one place look
    as nearly as can be like the one with those given (equation 9 of the paper).

    o' = 1 - (1 - o)^(1/n), and s' = s o / sum over i = 1..n and k = 0..i-1 of
    binomial(i - 1, k) (-1)^k o'^(k + 1) / sqrt(k + 1).
    """
    n = counts.clamp(1, _MOST)
    new = 1 - (1 - opacities.double()) ** (1 / n)
    # Over i the binomials add up: sum_{i > k}^{n} binomial(i - 1, k) = binomial(n, k + 1).
    k = torch.arange(_MOST, dtype=torch.float64, device=new.device)
    log_binomial = (
        torch.lgamma(n[:, None] + 1.0)
        - torch.lgamma(k + 2)
        - torch.lgamma((n[:, None] - k).clamp(min=1).double())
    )
    terms = torch.exp(log_binomial + (k + 1) * torch.log(new)[:, None]) / torch.sqrt(k + 1)
    terms = torch.where(k < n[:, None], terms * (-1) ** k, 0)
    factor = opacities / terms.sum(dim=1)
    return new.to(opacities.dtype), scales * factor[:, None].to(scales.dtype)


def _sample(
    splats: SplatParameters, rows: Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Draws `count` of the Gaussians `rows` in proportion to their opacity."""
    sums = torch.cumsum(splats.opacities[rows].double().cpu(), dim=0)
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * sums[-1]
    return rows[torch.searchsorted(sums, drawn).clamp(max=len(rows) - 1).to(rows.device)]


def _share(splats: SplatParameters, chosen: Tensor) -> None:
    """Gives each of the chosen Gaussians, which are to be copied as often as they occur, its part
    of what it was."""
    rows, copies = torch.unique(chosen, return_counts=True)
    # Of the parameters alone: the smallest scale is added to those of the copies again.
    scales = torch.exp(splats["log_scales"][rows])
    opacities, scales = share_out(splats.opacities[rows], scales, copies + 1)
    splats.overwrite("logit_opacities", torch.logit(opacities.clamp(1e-6, 1 - 1e-6)), rows)
    splats.overwrite("log_scales", torch.log(scales), rows)
