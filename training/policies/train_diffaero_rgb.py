"""Trains DiffAero's depth from RGB: proximity in each cell, from images of a corpus.

DiffAero, trained by depth, decides and stays as it is. A network learns to predict its grid of
inverse depths from one image, with the expected error of each cell: the negative log-likelihood of
Laplace's distribution, whose location is the median. Half of the images are flipped horizontally;
all are relit and noisy.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import bounded
from splatpilot.systems.policies.base import heading_frame, inverse_depth
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, MAX_DEPTH, MIN_DEPTH
from splatpilot.systems.policies.diffaero_rgb import (
    DIFFAERO_RGB_NETWORK,
    HEIGHT,
    WIDTH,
    DiffAeroRgbSpec,
    MonocularSpec,
    rays_B,
    require_view,
)
from splatpilot.systems.policies.networks import LEAK
from splatpilot.systems.policies.student import encode_color
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.policies.augmentation import change_appearance, check_noise, noisy_color
from splatpilot.training.policies.networks import (
    TrainableNetwork,
    load_weights,
    make_convolution,
)
from splatpilot.training.policies.student_data import CorpusTrainer
from splatpilot.training.policies.trainer import CorpusTraining, Schedule


class MonocularModule(nn.Module):
    """The network of a `MonocularSpec`, with the names of weights that `MonocularDepth` takes."""

    def __init__(self, spec: MonocularSpec) -> None:
        super().__init__()
        made = {
            layer.weight.removesuffix(".weight"): make_convolution(layer) for layer in spec.layers()
        }

        def blocks(name: str, count: int) -> nn.Sequential:
            return nn.Sequential(
                *(_Block(made[f"{name}.{i}.0"], made[f"{name}.{i}.1"]) for i in range(count))
            )

        self.stem, self.halving, self.head = made["stem"], made["halving"], made["head"]
        self.fine = blocks("fine", len(spec.fine_dilations))
        self.coarse = blocks("coarse", len(spec.coarse_dilations))

    def forward(self, view: Tensor) -> Tensor:
        """Predicts inverse depths and logarithms of their errors (N, 2, 9, 16) from views
        (N, 6, 90, 160)."""
        x = self.fine(nn.functional.leaky_relu(self.stem(view), LEAK))
        return self.head(self.coarse(nn.functional.leaky_relu(self.halving(x), LEAK)))


class _Block(nn.Sequential):
    """Two convolutions whose output is added to the input; it begins with adding zero."""

    def __init__(self, first: nn.Conv2d, second: nn.Conv2d) -> None:
        super().__init__(first, second)
        nn.init.zeros_(second.weight)

    def forward(self, input: Tensor) -> Tensor:
        first, second = self
        return input + second(nn.functional.leaky_relu(first(input), LEAK))


class DiffAeroRgbModule(nn.Module):
    """The monocular network, which learns, and DiffAero's, which is fixed."""

    def __init__(self, spec: DiffAeroRgbSpec = DIFFAERO_RGB_NETWORK) -> None:
        super().__init__()
        self.monocular = MonocularModule(spec.monocular)
        self.monocular = self.monocular.to(memory_format=torch.channels_last)
        self.policy = TrainableNetwork(spec.policy).requires_grad_(False)


_NEAR = 6.0  # [m] maximum depth of cells that are evaluated
_CLOSE = 0.25  # [-] maximum relative error of a successful prediction


@dataclass
class DiffAeroRgbTraining(CorpusTraining):
    """A training run of DiffAero by RGB."""

    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            updates=20000, validate_every=1000, checkpoint_every=500, learning_rate=2e-3, decay=0.8
        )
    )
    batch: int = bounded(64, "[1, inf)")
    # Computes layers in bfloat16, which is two to three times as fast on processors that have it.
    bfloat16: bool = False
    # File of DiffAero's weights; the shipped ones if empty.
    policy: str = ""
    noise: ObservationNoise = field(
        default_factory=lambda: ObservationNoise(color_noise=0.02, brightness_jitter=0.2)
    )

    def check(self) -> None:
        super().check()
        check_noise(self.noise, color=True, time=False)


class DiffAeroRgbTrainer(CorpusTrainer):
    """Trains DiffAero by RGB."""

    policy = "diffaero_rgb"
    spec = DIFFAERO_RGB_NETWORK
    network: DiffAeroRgbModule
    evaluated = "cells"
    metrics = f"""\
Of cells of images, not of flights: those whose minimum depth is below {_NEAR:g} m. `success` is the
fraction predicted within {_CLOSE:.0%}; `missed` the fraction nearer than 3 m that is predicted
beyond 5; `error` the mean absolute error of all cells' inverse depths, 3 m / z."""

    def __init__(self, config: DiffAeroRgbTraining) -> None:
        super().__init__(config)
        require_view(self._data.camera)
        self.network = DiffAeroRgbModule().to(config.device)
        policy = PolicyCheckpoint.load(config.policy, "diffaero", DIFFAERO_NETWORK)
        load_weights(self.network.policy, policy)
        if config.begin:
            checkpoint = PolicyCheckpoint.load(config.begin, self.policy, self.spec)
            load_weights(self.network.monocular, checkpoint, "monocular.")
        self.learns_from = self._data.digest(config.policy, config.begin)
        self._rays_B = torch.from_numpy(rays_B()).flatten(0, 1).to(config.device)
        self._targets = torch.from_numpy(self._min_depths()).to(config.device)

    def losses(self) -> dict[str, Tensor]:
        config, generator = self._config, self.generator
        color, rays, target = self._samples(self._data.draw(config.batch, generator))
        color = change_appearance(color, config.appearance, generator)
        color = noisy_color(color, config.noise, generator)
        flipped = torch.rand(config.batch, generator=generator, device=config.device) < 0.5
        view = flip(torch.cat([encode_color(color), rays], 1), flipped)
        target = torch.where(flipped[:, None, None], target.flip(2), target)
        inverse, log_error = self._predict(view)
        error = (inverse - target).abs()
        return {"likelihood": (error * torch.exp(-log_error) + log_error).mean()}

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Measures `metrics` on images without noise of held-out worlds."""
        rows = []
        for indices in self._validation:
            color, rays, target = self._samples(indices)
            rows.append((self._predict(torch.cat([encode_color(color), rays], 1))[0], target))
        predicted, target = (torch.cat(part) for part in zip(*rows, strict=True))
        z = 3.0 / (target + 0.6)
        z_predicted = 3.0 / (predicted + 0.6).clamp(3.0 / MAX_DEPTH, 3.0 / MIN_DEPTH)
        close = (z_predicted / z - 1.0).abs() < _CLOSE
        return {
            "success": float(close[z < _NEAR].float().mean()),
            "missed": float((z_predicted > 5.0)[z < 3.0].float().mean()),
            "error": float((predicted - target).abs().mean()),
        }

    def _predict(self, view: Tensor) -> tuple[Tensor, Tensor]:
        """Predicts inverse depths (N, 9, 16), and the logarithms of their errors, -4 to 3."""
        device = torch.device(self._config.device).type
        with torch.autocast(device, torch.bfloat16, enabled=self._config.bfloat16):
            found = self.network.monocular(view.contiguous(memory_format=torch.channels_last))
        inverse, log_error = found.float().unbind(1)
        return inverse, log_error.clamp(-4.0, 3.0)

    def _samples(self, indices: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Reads colors (N, 90, 160, 3), 0 to 255, rays in the heading frame (N, 3, 90, 160) and
        maximum inverse depths of cells (N, 9, 16)."""
        device = self._config.device
        color = self._data.pixels(indices, "color")[:, self._rows()]
        R_WB = rotation_matrices(self._data.labels(indices).X_WB[:, :4])
        R_WH = heading_frame(torch.atan2(R_WB[:, 1, 0], R_WB[:, 0, 0]))
        rays = ((R_WH.mT @ R_WB) @ self._rays_B.mT).unflatten(2, (HEIGHT, WIDTH))
        target = inverse_depth(self._targets[torch.from_numpy(indices)], MIN_DEPTH, MAX_DEPTH)
        return torch.from_numpy(color).to(device).float(), rays, target

    def _min_depths(self) -> np.ndarray:
        """Computes minimum depths (N, 9, 16) [m] in the cells of all samples."""
        spec = self.spec.policy
        h, w = spec.image_height, spec.image_width
        blocks = (-1, h, HEIGHT // h, w, WIDTH // w)
        kept = []
        for shard in Progress(self._data.shards, desc="reading depth", unit="shard"):
            depth = shard.arrays["depth"][:, self._rows()]
            kept.append(depth.reshape(blocks).min((2, 4)).astype(np.float32))
        return np.concatenate(kept)

    def _rows(self) -> slice:
        first = (self._data.camera.height - HEIGHT) // 2
        return slice(first, first + HEIGHT)


def flip(view: Tensor, which: Tensor) -> Tensor:
    """Flips views (N, 6, H, W), and their rays, horizontally where `which` (N,)."""
    sign = torch.ones(view.shape[1], device=view.device)
    sign[4] = -1.0
    return torch.where(which[:, None, None, None], view.flip(3) * sign[:, None, None], view)
