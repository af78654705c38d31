"""Fitting Gaussians to images and depth: the paper's equations 1 and 2, step by step."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.common.progress import CheckpointClock, Progress, resumable
from splatpilot.systems.splats.background import FAR, Background
from splatpilot.systems.splats.baked_scene import RenderedView, create_renderer
from splatpilot.systems.splats.rasterization import EPS2D
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction import mcmc
from splatpilot.training.reconstruction.checkpoint import Checkpoint, event_log
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.losses import (
    log_depth_loss,
    outline_loss,
    photometric_loss,
    surface_loss,
)
from splatpilot.training.reconstruction.mcmc import McmcStrategy
from splatpilot.training.reconstruction.metrics import HeldOutMeasures, measure_view
from splatpilot.training.reconstruction.parameters import (
    SplatParameters,
    learning_rates,
    scale_limits,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, fit_gain, seen_pixels
from splatpilot.training.reconstruction.quaternions import rotate
from splatpilot.training.reconstruction.splat_rendering import Rendering, render
from splatpilot.training.reconstruction.views import ReconstructionViews

# Adding and removing Gaussians where images ask for it: the strategy of 3D Gaussian splatting.
#
# Kerbl et al. 2023, section 5.2: Gaussians whose place on the image has a large gradient are
# doubled if small and split if large, faint and huge ones are removed, and opacities are reset now
# and then, so that what is not needed fades.


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
            gradient = means2d.grad
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


# What each step of a reconstruction minimises: equations 1 and 2 of the paper, and what holds
# Gaussians to the surfaces that depth shows.


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


# Unknown gains are fitted after these parts of all steps.
_GAIN_FITS = (0.1, 0.2, 0.4)
# Steps from one time that the limits of the scales are found to the next.
_LIMIT_EVERY = 500


class Optimization:
    """One run, from its first step or from a checkpoint.

    Args:
        config: how.
        views: what to fit.
        held_out: withheld frames to measure with; may be empty.
        background: of the scene, with which it is measured.
        initial: makes the Gaussians to start from; not called if there is a checkpoint.
        checkpoint: where to keep what was done.
        perceptual: LPIPS of two images (H, W, 3), or None.
        fit_gains: whether the gains of `views` are unknown, and to be found on the way.
    """

    def __init__(
        self,
        config: ReconstructConfig,
        views: ReconstructionViews,
        held_out: ReconstructionViews | None,
        background: Background,
        initial: Callable[[], GaussianScene],
        checkpoint: Checkpoint,
        perceptual: Callable[[Tensor, Tensor], Tensor] | None = None,
        fit_gains: bool = False,
    ):
        self._config, self._views, self._held_out = config, views, held_out
        self._checkpoint = checkpoint
        self._gain_steps = [int(f * config.iterations) for f in _GAIN_FITS] if fit_gains else []
        self._renderer = create_renderer(config.renderer_threads)
        self._background = background
        self._seen = []
        if held_out is not None:
            fitted = [ThinnedFrame.of(views.frame(k)) for k in range(len(views))]
            self._seen = [seen_pixels(held_out.frame(k), fitted) for k in range(len(held_out))]
        far = views.depths >= FAR
        solid = (views.depths > 0) & ~far
        both = far.flatten(1).any(dim=1) & solid.flatten(1).any(dim=1)
        self._outlined = both.tolist() if config.outline_weight > 0 else [False] * len(views)
        self._objective = Objective(config, views, perceptual)
        self.center, self.extent = views.extent()
        kept = checkpoint.load()
        if kept is None:
            self.step = 0
            self.gains = views.gains
            self.splats = SplatParameters.of_scene(initial(), config.sh_degree, config.device)
            self._limit_scales()
        else:
            self.step = kept["step"]
            self.splats = SplatParameters(**kept["splats"])
            self.gains = kept["gains"]
        self._strategy = self._make_strategy()
        if kept is not None and self._strategy is not None:
            self._strategy.restore(kept["strategy"])

    def run(self) -> None:
        """Takes all steps that remain, and shows how far it has come.

        Raises:
            OSError: if a checkpoint cannot be written.
        """
        config, splats = self._config, self.splats
        clock, kept_step = CheckpointClock(), self.step

        def kept() -> str:
            if not kept_step:
                return "no step is kept yet; the same command starts again"
            folder = self._checkpoint.folder
            return (
                f"step {kept_step} of {config.iterations} is in {folder}; the same command resumes"
            )

        progress = Progress(
            total=config.iterations, initial=self.step, desc="optimizing", unit="step"
        )
        with progress, event_log(config.tensorboard) as log, resumable(kept):
            while self.step < config.iterations:
                self.take_step()
                progress.update()
                if self.step % config.measure_every == 0:
                    found = self.measure()
                    log(self.step, {"gaussians": len(splats), **(found.means() if found else {})})
                    told = f"{len(splats)} Gaussians" + (f", held-out {found}" if found else "")
                    progress.set_postfix_str(told, refresh=False)
                every = self.step % config.checkpoint_every == 0
                if every or self.step == config.iterations or clock.is_due:
                    with clock.writing():
                        self._save()
                    kept_step = self.step

    def take_step(self) -> None:
        """Fits one image a little better.

        Where something stands out against the infinitely far, every other step fits its outline
        instead of colours, drawn as depth cameras see it: without the blur of colour cameras.
        """
        config, splats, count = self._config, self.splats, len(self.splats)
        k = self._image_of_step(self.step)
        viewmat, K = self._views.camera(k, config.device)
        backdrop = self._backdrop_of_step(self.step)
        gaussians = self._gaussians(config.device)
        outlines = self._outlined[k] and self.step % 2 == 1
        rendering = render(
            config.representation,
            gaussians,
            viewmat,
            K,
            self._views.width,
            self._views.height,
            background=backdrop,
            depth_mode=config.depth_mode,
            eps2d=0.0 if outlines else EPS2D,
            distortion=self._objective.wants_distortion(self.step),
            renderer=self._renderer,
        )
        loss = self._objective.loss(
            rendering, gaussians, k, self.gains[k], self.step, backdrop, outlines
        )
        if config.strategy == "mcmc":
            loss = loss + mcmc.penalty(splats)
        if self._strategy is not None:
            self._strategy.watch(rendering)
        loss.backward()
        if self._strategy is not None:
            self._strategy.observe(rendering, splats, viewmat, K)
        rates = learning_rates(config, self.extent, self.step / config.iterations)
        splats.step(rates)
        self.step += 1
        if self.step in self._gain_steps:
            self._fit_gains()
        if self._strategy is not None:
            self._strategy.refine(self.step, splats, rates)
        if self.step % _LIMIT_EVERY == 0 or len(splats) != count:
            self._limit_scales()

    @torch.no_grad()
    def measure(self) -> HeldOutMeasures | None:
        """Measures the Gaussians as they are on the withheld frames, if there are any."""
        views = self._held_out
        if views is None:
            return None
        found = []
        for k, seen in enumerate(self._renderings(views)):
            images = (image.numpy() for image in (seen.color, seen.depth, seen.alpha))
            view, frame = RenderedView(*images), views.frame(k)
            found.append(
                measure_view(view, self._background, frame, views.vignetting, self._seen[k])
            )
        return HeldOutMeasures(tuple(found))

    def _limit_scales(self) -> None:
        bounded = self._config.initialization == "depth"
        self.splats.limit_scales(scale_limits(self.splats["means"], self._views, bounded))

    def _gaussians(self, device: str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        splats = self.splats
        scales, opacities = splats.shapes()
        return (
            splats["means"].to(device),
            splats["quats"].to(device),
            scales.to(device),
            opacities.to(device),
            splats.sh.to(device),
        )

    @torch.no_grad()
    def _fit_gains(self) -> None:
        """Sets the gain of each image to what suits what is seen so far; their mean stays 1."""
        views = self._views
        gains = []
        for k, seen in enumerate(self._renderings(views)):
            color = seen.color * views.vignette[..., None]
            image = seen.alpha[..., None] * views.images[k] / 255
            gains.append(fit_gain(color, image, views.valid[k]))
        log_gains = torch.log(torch.tensor(gains).clamp(min=0.1))
        self.gains = torch.exp(log_gains - log_gains.mean())

    def _renderings(self, views: ReconstructionViews) -> Iterator[Rendering]:
        """Renders the Gaussians as each view sees them, on black, with median depth; on the CPU,
        as cameras in flight do, wherever they are optimised."""
        gaussians = self._gaussians("cpu")
        for k in range(len(views)):
            yield render(
                self._config.representation,
                gaussians,
                *views.camera(k, "cpu"),
                views.width,
                views.height,
                depth_mode="MD",
                renderer=self._renderer,
            )

    def _image_of_step(self, step: int) -> int:
        """All images in random order, then all again in another; it depends on the step alone."""
        n = len(self._views)
        return int(np.random.default_rng([self._config.seed, step // n]).permutation(n)[step % n])

    def _backdrop_of_step(self, step: int) -> Tensor:
        """(1, 3), a colour to have behind everything in this step alone: what looks right before
        any colour is opaque. It depends on the step alone."""
        color = np.random.default_rng([self._config.seed, step, 1]).random((1, 3), np.float32)
        return torch.from_numpy(color).to(self._config.device)

    def _make_strategy(self) -> DefaultStrategy | McmcStrategy | None:
        if self._config.strategy == "default":
            center = torch.tensor(self.center, dtype=torch.float32, device=self._config.device)
            return DefaultStrategy(self._config, center, self.extent, len(self.splats))
        return McmcStrategy(self._config) if self._config.strategy == "mcmc" else None

    def _save(self) -> None:
        strategy = {} if self._strategy is None else self._strategy.state()
        state = self.splats.state()
        self._checkpoint.save(
            {
                "step": self.step,
                "splats": state,
                "strategy": strategy,
                "gains": self.gains,
            }
        )
