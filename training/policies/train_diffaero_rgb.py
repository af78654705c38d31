"""Training DiffAero to see in colours: how near things are in each cell, from images of a corpus.

What decides is DiffAero as it was trained by depth, and stays as it is; what is learned is the grid
of inverse depths that it flies by, from one image, with the error to be expected in each cell: the
negative log-likelihood of Laplace's distribution, so that the median is what is flown by. Half of
the images are mirrored, all are relit and disturbed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.seeds import check_seed
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, MAX_DEPTH, MIN_DEPTH
from splatpilot.systems.policies.diffaero_rgb import (
    DIFFAERO_RGB_NETWORK,
    HEIGHT,
    WIDTH,
    Layer,
    MonocularSpec,
    rays_B,
    require_view,
)
from splatpilot.systems.policies.observations import heading_frame, inverse_depth
from splatpilot.systems.policies.recurrent_network import LEAK
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.image_noise import noisy_color, validate_training_noise
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_images import Appearance, relit
from splatpilot.training.policies.student_network import encode_color
from splatpilot.training.policies.trainer import Schedule


class MonocularModule(nn.Module):
    """The network of a `MonocularSpec`, with the names of weights that `MonocularDepth` takes."""

    def __init__(self, spec: MonocularSpec) -> None:
        super().__init__()
        made = {layer.name: _convolution(layer) for layer in spec.layers()}

        def blocks(name: str, count: int) -> nn.Sequential:
            return nn.Sequential(
                *(_Block(made[f"{name}.{i}.0"], made[f"{name}.{i}.1"]) for i in range(count))
            )

        self.stem, self.halving, self.head = made["stem"], made["halving"], made["head"]
        self.fine = blocks("fine", len(spec.fine_dilations))
        self.coarse = blocks("coarse", len(spec.coarse_dilations))

    def forward(self, view: Tensor) -> Tensor:
        """Inverse depths and logarithms of their errors (N, 2, 9, 16) of views (N, 6, 90, 160)."""
        x = self.fine(nn.functional.leaky_relu(self.stem(view), LEAK))
        return self.head(self.coarse(nn.functional.leaky_relu(self.halving(x), LEAK)))


class _Block(nn.Sequential):
    """Two convolutions whose output is added to the input; it begins with adding nothing."""

    def __init__(self, first: nn.Conv2d, second: nn.Conv2d) -> None:
        super().__init__(first, second)
        nn.init.zeros_(second.weight)

    def forward(self, input: Tensor) -> Tensor:
        first, second = self
        return input + second(nn.functional.leaky_relu(first(input), LEAK))


class DiffAeroRgbModule(nn.Module):
    """What sees, which learns, and what decides, which has learned."""

    def __init__(self) -> None:
        super().__init__()
        self.monocular = MonocularModule(DIFFAERO_RGB_NETWORK.monocular)
        self.monocular = self.monocular.to(memory_format=torch.channels_last)
        self.policy = TrainableNetwork(DIFFAERO_RGB_NETWORK.policy).requires_grad_(False)

    def load_policy(self, weights: str) -> None:
        """Has the policy be DiffAero of a file of weights, of those that ship if empty."""
        checkpoint = PolicyCheckpoint.load(weights, "diffaero", DIFFAERO_NETWORK)
        self.policy.load_state_dict(
            {name: torch.from_numpy(values) for name, values in checkpoint.weights.items()}
        )

    def load_sight(self, weights: str) -> None:
        """Has it see as the `diffaero_rgb` of a file of weights."""
        checkpoint = PolicyCheckpoint.load(weights, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
        self.monocular.load_state_dict(
            {
                name.removeprefix("monocular."): torch.from_numpy(values)
                for name, values in checkpoint.weights.items()
                if name.startswith("monocular.")
            }
        )


def _convolution(layer: Layer) -> nn.Conv2d:
    return nn.Conv2d(
        layer.inputs,
        layer.outputs,
        layer.kernel,
        layer.stride,
        layer.dilation * (layer.kernel // 2),
        layer.dilation,
    )


_NEAR = 6.0
"""[m] Nearer than that a cell counts in what is measured."""

_CLOSE = 0.25
"""[-] Relative error of a depth that is judged well."""


@dataclass
class DiffAeroRgbTraining:
    """A training run."""

    # Seed of everything random, 0 to 2147483647.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    # Folders of what is learned from, as `splatpilot corpus make` writes them.
    corpora: list[str] = field(default_factory=lambda: ["out/corpus"])
    # [-] Part of the corpora's worlds, by name, that choose among checkpoints instead.
    held_out: float = 0.1
    # [-] Held-out samples that are looked at, evenly spaced.
    validation_samples: int = 2000
    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            updates=20000, validate_every=1000, checkpoint_every=500, learning_rate=2e-3, decay=0.8
        )
    )
    # [-] Samples a step of the optimiser.
    batch: int = 64
    # Whether layers compute in bfloat16, which processors and GPUs that have it do two to three
    # times as fast; weights are kept in single precision.
    bfloat16: bool = False
    # File of DiffAero's weights, which decide; those that ship where left empty.
    policy: str = ""
    # File of this policy's weights, whose sight is trained further; from nothing where left empty.
    begin: str = ""
    # How far images are relit.
    appearance: Appearance = field(default_factory=Appearance)
    # What the images are disturbed by.
    noise: ObservationNoise = field(
        default_factory=lambda: ObservationNoise(color_noise=0.02, brightness_jitter=0.2)
    )

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        check_seed(self.seed)
        self.schedule.validate()
        if not self.corpora:
            raise ValueError("corpora is empty; name one or more folders of corpora")
        if not 0.0 <= self.held_out <= 0.9:
            raise ValueError(f"held_out is {self.held_out}; it must be 0 to 0.9")
        for name in ("batch", "validation_samples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        validate_training_noise(self.noise, "noise", of_depth=False, of_colors=True, of_time=False)
        self.appearance.validate("appearance")


class DiffAeroRgbTrainer:
    """See `splatpilot.training.policies.trainer.Trainer`."""

    policy = "diffaero_rgb"
    spec = DIFFAERO_RGB_NETWORK
    evaluated = "cells"
    measures = f"""\
Of cells of images, not of flights: those whose nearest depth is below {_NEAR:g} m. `success` is the
part judged within {_CLOSE:.0%}; `missed` the part nearer than 3 m that is taken for farther than 5;
`error` the mean absolute error of all cells' inverse depths, 3 m / z."""

    def __init__(self, config: DiffAeroRgbTraining) -> None:
        self._config = config
        corpora = [Corpus(Path(path)) for path in config.corpora]
        self._data = StudentData(corpora, config.held_out, config.device)
        require_view(self._data.camera.width, self._data.camera.height)
        self.network = DiffAeroRgbModule().to(config.device)
        self.network.load_policy(config.policy)
        if config.begin:
            self.network.load_sight(config.begin)
        self.learns_from = self._data.digest(config.policy, config.begin)
        self._rays_B = torch.from_numpy(rays_B()).flatten(0, 1).to(config.device)
        self._targets = torch.from_numpy(self._nearest()).to(config.device)
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        data, count = self._data.held_out, config.validation_samples
        self._validation = data[np.linspace(0, len(data) - 1, min(count, len(data))).astype(int)]

    def begin_update(self, update: int) -> None:
        pass

    def losses(self) -> dict[str, Tensor]:
        config, training, generator = self._config, self._data.training, self._generator
        drawn = torch.randint(
            len(training), (config.batch,), generator=generator, device=config.device
        )
        color, rays, target = self._samples(training[drawn.cpu().numpy()])
        draws = torch.rand(3, config.batch, generator=generator, device=config.device)
        look = 2.0 * draws[:2] - 1.0
        appearance = config.appearance
        gain = 2.0 ** (appearance.exposure * look[0])
        color = noisy_color(relit(color, gain, appearance.hue * look[1]), config.noise, generator)
        view = mirrored(torch.cat([encode_color(color), rays], 1), draws[2] < 0.5)
        target = torch.where((draws[2] < 0.5)[:, None, None], target.flip(2), target)
        inverse, log_error = self._judge(view)
        error = (inverse - target).abs()
        return {"likelihood": (error * torch.exp(-log_error) + log_error).mean()}

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """On held-out worlds, of clean images; see `measures`."""
        rows = list(self._judged_validation())
        found, target = (torch.cat(part) for part in zip(*rows, strict=True))
        z = 3.0 / (target + 0.6)
        judged = 3.0 / (found + 0.6).clamp(3.0 / MAX_DEPTH, 3.0 / MIN_DEPTH)
        near, very_near = z < _NEAR, z < 3.0
        return {
            "success": float(((judged / z - 1.0).abs() < _CLOSE)[near].float().mean()),
            "missed": float((judged > 5.0)[very_near].float().mean()),
            "error": float((found - target).abs().mean()),
        }

    def state_dict(self) -> dict[str, Any]:
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._generator.set_state(state["generator"])

    def _judged_validation(self) -> Iterator[tuple[Tensor, Tensor]]:
        for first in range(0, len(self._validation), self._config.batch):
            numbers = self._validation[first : first + self._config.batch]
            color, rays, target = self._samples(numbers)
            yield self._judge(torch.cat([encode_color(color), rays], 1))[0], target

    def _judge(self, view: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse depths (N, 9, 16), and the logarithms of their errors, -4 to 3."""
        kind = torch.device(self._config.device).type
        with torch.autocast(kind, torch.bfloat16, enabled=self._config.bfloat16):
            found = self.network.monocular(view.contiguous(memory_format=torch.channels_last))
        inverse, log_error = found.float().unbind(1)
        return inverse, log_error.clamp(-4.0, 3.0)

    def _samples(self, numbers: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (N, 90, 160, 3), 0 to 255, rays in the heading frame (N, 3, 90, 160) and nearest
        inverse depths (N, 9, 16) of samples."""
        device = self._config.device
        color = self._data.pixels(numbers, "color")[:, self._rows()]
        R_WB = rotation_matrices(self._data.labels(numbers).X_WB[:, :4])
        R_WH = heading_frame(torch.atan2(R_WB[:, 1, 0], R_WB[:, 0, 0]))
        rays = ((R_WH.mT @ R_WB) @ self._rays_B.mT).unflatten(2, (HEIGHT, WIDTH))
        target = inverse_depth(self._targets[torch.from_numpy(numbers)], MIN_DEPTH, MAX_DEPTH)
        return torch.from_numpy(color).to(device).float(), rays, target

    def _nearest(self) -> np.ndarray:
        """The nearest depths (N, 9, 16) [m] in the cells of all samples."""
        spec = self.spec.policy
        h, w = spec.image_height, spec.image_width
        blocks = (-1, h, HEIGHT // h, w, WIDTH // w)
        kept = []
        for shard in Progress(self._data.shards, desc="reading depth", unit="shard"):
            depth = shard.arrays["depth"][:, self._rows()]
            kept.append(depth.reshape(blocks).min((2, 4)).astype(np.float32))
        return np.concatenate(kept)

    def _rows(self) -> slice:
        """Those in the middle of the corpora's images."""
        first = (self._data.camera.height - HEIGHT) // 2
        return slice(first, first + HEIGHT)


def mirrored(view: Tensor, which: Tensor) -> Tensor:
    """Views (N, 6, H, W), those of `which` (N,) seen in a mirror: left is right, of rays too."""
    sign = torch.ones(view.shape[1], device=view.device)
    sign[4] = -1.0
    return torch.where(which[:, None, None, None], view.flip(3) * sign[:, None, None], view)
