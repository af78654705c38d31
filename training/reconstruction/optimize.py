"""Fitting Gaussians to images and depth: the paper's equations 1 and 2, step by step."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.progress import CheckpointClock, Progress, resumable
from splatpilot.systems.splats.background import FAR, Background
from splatpilot.systems.splats.baked_scene import RenderedView, create_renderer
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.rasterization import EPS2D
from splatpilot.training.event_log import event_log
from splatpilot.training.reconstruction import mcmc
from splatpilot.training.reconstruction.checkpoint import Checkpoint
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.densification import DefaultStrategy
from splatpilot.training.reconstruction.learning_rates import learning_rates
from splatpilot.training.reconstruction.mcmc import McmcStrategy
from splatpilot.training.reconstruction.measures import HeldOutMeasures, measure_view
from splatpilot.training.reconstruction.objective import Objective
from splatpilot.training.reconstruction.overlap import ThinnedFrame, seen_pixels
from splatpilot.training.reconstruction.photometry import fit_gain
from splatpilot.training.reconstruction.scale_limits import scale_limits
from splatpilot.training.reconstruction.splat_parameters import SplatParameters
from splatpilot.training.reconstruction.splat_rendering import Rendering, render
from splatpilot.training.reconstruction.views import ReconstructionViews

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
            absgrad=config.absgrad and config.strategy == "default",
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
