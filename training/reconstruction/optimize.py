"""Optimization of Gaussians to fit images and depth: the paper's equations 1 and 2."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.common.progress import CheckpointClock, Progress
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.rasterization import EPS2D
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.reconstruction.checkpoint import Checkpoint, event_log
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.losses import (
    log_depth_loss,
    outline_loss,
    photometric_loss,
    surface_loss,
)
from splatpilot.training.reconstruction.metrics import HeldOutMetrics, measure_view
from splatpilot.training.reconstruction.parameters import (
    SplatParameters,
    learning_rates,
    scale_limits,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, fit_gain, seen_pixels
from splatpilot.training.reconstruction.splat_rendering import Rendering, render
from splatpilot.training.reconstruction.views import ReconstructionViews

# As published for 3DGS: gradient in half widths of the image above which a Gaussian is cloned or
# split, opacity below which it is removed, and sizes relative to the extent of the scene.
_GROW_GRADIENT, _PRUNE_OPACITY = 2e-4, 0.005
_LARGE, _HUGE = 0.01, 0.1
_SPLIT_SHRINK = 1.6
# As published for 2DGS: weights of the distortion along rays and of the angle between normals, and
# the fractions of all steps after which they start.
_DISTORTION_WEIGHT, _DISTORTION_START = 0.01, 0.1
_NORMAL_WEIGHT, _NORMAL_START = 0.05, 7 / 30
_LPIPS_FRACTION, _LPIPS_EVERY = 0.1, 4  # of the last steps, one in four computes LPIPS
_SURFACE_FRACTION = 1 / 4  # of the Gaussians in view, drawn in each step for the surface loss
_GAIN_FITS = (0.1, 0.2, 0.4)  # fractions of all steps after which unknown gains are fitted
_MIN_LIMIT_STEPS = 500  # between updates of the scale limits, or a quarter of all steps
_MEASURE_EVERY = 1000  # steps between metrics on held-out frames


class DefaultStrategy:
    """Densification of 3D Gaussian splatting (Kerbl et al. 2023, section 5.2). Clones small and
    splits large Gaussians with a large gradient on the image, removes faint and huge ones, and
    resets opacities periodically. The cameras are within `extent` [m] of `center` (3,) [m]."""

    def __init__(self, config: ReconstructConfig, center: Tensor, extent: float, count: int):
        self._config, self._center, self._extent = config, center, extent
        self._clear(count)

    def watch(self, rendering: Rendering) -> None:
        """Makes the next backward pass keep the gradients of positions on the image."""
        if self._config.representation == "3dgs":
            rendering.meta["means2d"].retain_grad()

    @torch.no_grad()
    def observe(
        self, rendering: Rendering, splats: SplatParameters, viewmat: Tensor, K: Tensor
    ) -> None:
        """Sums the gradients of a backward pass, in half widths and heights of the image."""
        meta = rendering.meta
        rows = meta["gaussian_ids"]
        if self._config.representation == "3dgs":
            gradient = meta["means2d"].grad
        else:
            # Surfels: u = f x / z, so dL/du is about z / f dL/dx with x in the camera.
            v_means = splats["means"].grad
            assert v_means is not None
            gradient = (v_means[rows] @ viewmat[0, :3, :3].T)[:, :2]
            gradient = gradient * (meta["depths"][:, None] / K[0, [0, 1], [0, 1]])
        half = gradient.new_tensor([meta["width"] / 2, meta["height"] / 2])
        self.gradients.index_add_(0, rows, (gradient * half).norm(dim=1))
        self.counts.index_add_(0, rows, torch.ones_like(rows, dtype=torch.float32))

    @torch.no_grad()
    def refine(self, step: int, splats: SplatParameters) -> None:
        """Changes the Gaussians, if scheduled, after step `step` (from 1)."""
        config = self._config
        if step > config.refine_fraction * config.iterations:
            return
        if step >= config.refine_start and step % config.refine_every == 0:
            self._grow(splats, torch.Generator().manual_seed(config.seed * 1_000_003 + step))
            bad = splats.opacities < _PRUNE_OPACITY
            if 0 < config.reset_every < step:
                bad |= splats.scales.max(dim=1).values > _HUGE * self._reach(splats["means"])
            splats.rebuild(torch.nonzero(~bad)[:, 0])
            self._clear(len(splats))
        if config.reset_every and step % config.reset_every == 0:
            faint = torch.logit(torch.tensor(2 * _PRUNE_OPACITY)).item()
            splats.overwrite("logit_opacities", splats["logit_opacities"].clamp(max=faint))

    def _clear(self, count: int) -> None:
        self.gradients = self._center.new_zeros(count)
        self.counts = self._center.new_zeros(count)

    def _reach(self, means: Tensor) -> Tensor:
        """Returns the size (N,) [m] to which those of Gaussians are compared."""
        return (means - self._center).norm(dim=1).clamp(min=self._extent)

    def _grow(self, splats: SplatParameters, generator: torch.Generator) -> None:
        gradient = self.gradients / self.counts.clamp(min=1)
        grow = gradient > _GROW_GRADIENT
        free = max(self._config.max_gaussians - len(splats), 0)
        if grow.sum() > free:
            strongest = torch.sort(gradient, descending=True, stable=True).indices[:free]
            grow = torch.zeros_like(grow).index_fill(0, strongest, True)
        large = splats.scales.max(dim=1).values > _LARGE * self._reach(splats["means"])
        clone = torch.nonzero(grow & ~large)[:, 0]
        split = torch.nonzero(grow & large)[:, 0].repeat(2)

        added = {n: splats[n][torch.cat([clone, split])].clone() for n in splats.names}
        parts = slice(len(clone), None)
        random = torch.randn((len(split), 3), generator=generator).to(splats["means"].device)
        R = rotation_matrices(splats["quats"][split])
        added["means"][parts] += (R @ (random * splats.scales[split])[..., None])[..., 0]
        added["log_scales"][parts] -= np.log(_SPLIT_SHRINK)
        splats.rebuild(torch.nonzero(~(grow & large))[:, 0], added)


def needs_distortion(config: ReconstructConfig, step: int) -> bool:
    return config.representation == "2dgs" and step >= _DISTORTION_START * config.iterations


def view_loss(
    config: ReconstructConfig,
    views: ReconstructionViews,
    k: int,
    rendering: Rendering,
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    *,
    gain: Tensor,
    step: int,
    background: Tensor,
    outlines: bool,
    perceptual: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Tensor:
    """Returns the loss of the rendering of view `k` before `background` (1, 3), in an image of this
    gain; `outlines` are fitted instead of colors. `perceptual` is LPIPS of two images (H, W, 3)."""
    device = config.device
    frame = views.frames[k]
    depth = torch.from_numpy(frame.depth).to(device)
    edges = views.edges[k].to(device).float()
    if outlines:
        loss = config.outline_weight * outline_loss(rendering.alpha, depth, edges)
    else:
        target = views.target(frame, gain, background.cpu()[0]).to(device)
        color = rendering.color
        if not frame.valid.all():
            # Invalid pixels are equal in both, so that no window compares them.
            valid, same = torch.tensor(frame.valid, device=device)[..., None], color.detach()
            color, target = (torch.where(valid, image, same) for image in (color, target))
        loss = photometric_loss(color, target)
        late = step >= (1 - _LPIPS_FRACTION) * config.iterations
        if perceptual is not None and late and step % _LPIPS_EVERY == 0:
            distance = perceptual(color.clamp(0, 1), target.clamp(0, 1))
            loss = loss + config.lpips_weight * _LPIPS_EVERY * distance
    if config.depth_weight > 0:
        loss = loss + config.depth_weight * log_depth_loss(rendering.depth, depth, edges)
    if config.surface_weight > 0:
        rng = np.random.default_rng([config.seed, step, 2])
        seen = rendering.meta["gaussian_ids"]
        seen = seen[torch.from_numpy(rng.random(len(seen)) < _SURFACE_FRACTION).to(device)]
        viewmat, K = views.camera(k, device)
        on_surface = surface_loss(*gaussians[:3], seen, viewmat[0], K[0], depth, rng)
        loss = loss + config.surface_weight * on_surface
    if rendering.normals is None or rendering.surface_normals is None:
        return loss
    if needs_distortion(config, step) and rendering.distortion is not None:
        loss = loss + _DISTORTION_WEIGHT * rendering.distortion.mean()
    if step >= _NORMAL_START * config.iterations:
        surface = rendering.surface_normals * rendering.alpha.detach()[..., None]
        cosine = (rendering.normals * surface).sum(dim=-1)
        loss = loss + _NORMAL_WEIGHT * (1 - cosine).mean()
    return loss


class Optimization:
    """One run, from its first step or from a checkpoint. `initial` makes the Gaussians of a first
    step, given the extent of the cameras [m]; `perceptual` is the LPIPS of two images (H, W, 3);
    `fit_gains` fits the gains of `views`."""

    def __init__(
        self,
        config: ReconstructConfig,
        views: ReconstructionViews,
        held_out: ReconstructionViews | None,
        background: Background,
        initial: Callable[[float], GaussianScene],
        checkpoint: Checkpoint,
        perceptual: Callable[[Tensor, Tensor], Tensor] | None = None,
        fit_gains: bool = False,
    ):
        self._config, self._views, self._held_out = config, views, held_out
        self._background, self._checkpoint = background, checkpoint
        self._gain_steps = [int(f * config.iterations) for f in _GAIN_FITS] if fit_gains else []
        self._renderer = create_renderer(config.renderer_threads)
        self._seen = []
        if held_out is not None:
            fitted = [ThinnedFrame.of(frame) for frame in views.frames]
            self._seen = [seen_pixels(frame, fitted) for frame in held_out.frames]
        self._perceptual = perceptual
        center, extent = views.extent()
        # The distance of the cameras from each other says little about surfaces of known depth.
        self._length = views.median_depth if config.initialization == "depth" else extent
        state = checkpoint.load()
        if state is None:
            self.step, self.gains = 0, views.gains
            self.splats = SplatParameters.of_scene(initial(extent), config.sh_degree, config.device)
            self._limit_scales()
        else:
            self.step, self.gains = state["step"], state["gains"]
            self.splats = SplatParameters(**state["splats"])
        self._strategy = None
        if config.strategy == "default":
            center = torch.tensor(center, dtype=torch.float32, device=config.device)
            self._strategy = DefaultStrategy(config, center, extent, len(self.splats))
            if state is not None:
                self._strategy.gradients, self._strategy.counts = state["strategy"]

    def run(self) -> None:
        """Takes all remaining steps and shows progress."""
        config, splats, clock = self._config, self.splats, CheckpointClock()
        progress = Progress(
            total=config.iterations, initial=self.step, desc="optimizing", unit="step"
        )
        with progress, event_log(config.tensorboard) as log:
            while self.step < config.iterations:
                self.take_step()
                progress.update()
                if self.step % _MEASURE_EVERY == 0:
                    found = self.measure()
                    log(self.step, {"gaussians": len(splats), **(found.means() if found else {})})
                    status = f"{len(splats)} Gaussians" + (f", held-out {found}" if found else "")
                    progress.set_postfix_str(status, refresh=False)
                every = self.step % config.checkpoint_every == 0
                if every or self.step == config.iterations or clock.is_due:
                    with clock.writing():
                        self._save()

    def take_step(self) -> None:
        """Fits an image or, in some steps, the outlines of objects before the sky, without blur."""
        config, splats, count = self._config, self.splats, len(self.splats)
        # Image and background color are random, but depend only on seed and step.
        n = len(self._views)
        order = np.random.default_rng([config.seed, self.step // n]).permutation(n)
        k = int(order[self.step % n])
        color = np.random.default_rng([config.seed, self.step, 1]).random((1, 3), np.float32)
        background = torch.from_numpy(color).to(config.device)
        viewmat, K = self._views.camera(k, config.device)
        gaussians = self._gaussians(config.device)
        chance = np.random.default_rng([config.seed, self.step, 3]).random()
        outlines = config.outline_weight > 0 and chance < self._views.outline_shares[k]
        rendering = render(
            config.representation,
            gaussians,
            viewmat,
            K,
            self._views.width,
            self._views.height,
            background=background,
            depth_mode=config.depth_mode,
            eps2d=0.0 if outlines else EPS2D,
            distortion=needs_distortion(config, self.step),
            renderer=self._renderer,
        )
        loss = view_loss(
            config,
            self._views,
            k,
            rendering,
            gaussians,
            gain=self.gains[k],
            step=self.step,
            background=background,
            outlines=outlines,
            perceptual=self._perceptual,
        )
        if self._strategy is not None:
            self._strategy.watch(rendering)
        loss.backward()
        if self._strategy is not None:
            self._strategy.observe(rendering, splats, viewmat, K)
        splats.step(learning_rates(config, self._length, self.step / config.iterations))
        self.step += 1
        if self.step in self._gain_steps:
            self._fit_gains()
        if self._strategy is not None:
            self._strategy.refine(self.step, splats)
        every = max(_MIN_LIMIT_STEPS, config.iterations // 4)
        if self.step % every == 0 or len(splats) != count:
            self._limit_scales()

    @torch.no_grad()
    def measure(self) -> HeldOutMetrics | None:
        """Returns the metrics of the held-out frames, if there are any."""
        views = self._held_out
        if views is None:
            return None
        each = zip(self._renderings(views), views.frames, self._seen, strict=True)
        return HeldOutMetrics(
            tuple(
                measure_view(rendering.view(), self._background, frame, views.vignetting, seen)
                for rendering, frame, seen in each
            )
        )

    def _limit_scales(self) -> None:
        bounded = self._config.initialization == "depth"
        self.splats.limit_scales(scale_limits(self.splats["means"], self._views, bounded))

    def _gaussians(self, device: str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        splats = self.splats
        tensors = (splats["means"], splats["quats"], *splats.shapes(), splats.sh)
        means, quats, scales, opacities, sh = (tensor.to(device) for tensor in tensors)
        return means, quats, scales, opacities, sh

    @torch.no_grad()
    def _fit_gains(self) -> None:
        """Fits the gain of each image to the current scene; the mean of their logarithms is 0."""
        views = self._views
        gains = []
        for frame, rendering in zip(views.frames, self._renderings(views), strict=True):
            color = rendering.color * views.vignette[..., None]
            image = rendering.alpha[..., None] * torch.from_numpy(frame.image) / 255
            gains.append(fit_gain(color, image, torch.tensor(frame.valid)))
        log_gains = torch.log(torch.tensor(gains).clamp(min=0.1))
        self.gains = torch.exp(log_gains - log_gains.mean())

    def _renderings(self, views: ReconstructionViews) -> Iterator[Rendering]:
        """Renders each view on black with median depth, on the CPU, as cameras in flight do."""
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

    def _save(self) -> None:
        strategy = self._strategy
        self._checkpoint.save(
            {
                "step": self.step,
                "splats": self.splats.state(),
                "strategy": None if strategy is None else [strategy.gradients, strategy.counts],
                "gains": self.gains,
            }
        )
