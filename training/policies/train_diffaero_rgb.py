"""Trains both policies of RGB: DiffAero's depth from images of a corpus, and all of it in flight.

`diffaero_rgb`: DiffAero, trained by depth, decides. A network learns to predict its grid of inverse
depths from one image, with the error of each cell, by Laplace's likelihood.

`distilled_rgb`: point masses fly by the student's decisions from rendered images; the teacher,
DiffAero, decides from depth, with a memory of its own: DAgger (Ross, Gordon and Bagnell, 2011) in
which only the student flies. The loss has the difference of both decisions, the likelihood of the
teacher's depth grid, and DiffAero's loss through the dynamics, in which images are constant. Every
second vehicle flies in the mirror image of its world.
"""

from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import VALIDATION_SEEDS, first_training_seed
from splatpilot.systems.common.validation import bounded, require_field
from splatpilot.systems.policies.base import (
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
    pool_depth,
)
from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    checkpoint_policy,
    shipped_weights,
)
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, MAX_DEPTH, MIN_DEPTH
from splatpilot.systems.policies.diffaero_rgb import (
    DIFFAERO_RGB_NETWORK,
    DISTILLED_RGB_NETWORK,
    HEIGHT,
    WIDTH,
    DiffAeroRgbSpec,
    DistilledRgbConfig,
    MonocularSpec,
    rays_B,
    require_view,
)
from splatpilot.systems.policies.networks import LEAK
from splatpilot.systems.policies.student import encode_color
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.policies.augmentation import (
    Appearance,
    change_appearance,
    check_noise,
    color_noise,
    noisy_color,
)
from splatpilot.training.policies.networks import (
    TrainableNetwork,
    load_weights,
    make_convolution,
)
from splatpilot.training.policies.rollouts import (
    FlightConditions,
    RolloutConfig,
    RolloutTrainer,
    RolloutTraining,
    Transitions,
)
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.train_student import CorpusTrainer
from splatpilot.training.policies.trainer import CorpusTraining, Schedule
from splatpilot.training.policies.training_worlds import WorldViews
from splatpilot.training.policies.vehicles import Observation


class MonocularModule(nn.Module):
    """The network of a `MonocularSpec`, with the names of weights that `MonocularDepth` takes."""

    def __init__(self, spec: MonocularSpec) -> None:
        super().__init__()
        layers = spec.layers()
        made = {layer.weight.removesuffix(".weight"): make_convolution(layer) for layer in layers}

        def blocks(name: str, count: int) -> nn.Sequential:
            pairs = [(made[f"{name}.{i}.0"], made[f"{name}.{i}.1"]) for i in range(count)]
            return nn.Sequential(*(_Block(*pair) for pair in pairs))

        self.stem, self.halving, self.head = made["stem"], made["halving"], made["head"]
        self.fine = blocks("fine", len(spec.fine_dilations))
        self.coarse = blocks("coarse", len(spec.coarse_dilations))

    def forward(self, view: Tensor) -> Tensor:
        """Predicts inverse depths and logarithms of errors (N, 2, 9, 16) from views."""
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

    _rays_B: Tensor

    def __init__(self, spec: DiffAeroRgbSpec = DIFFAERO_RGB_NETWORK) -> None:
        super().__init__()
        self.spec = spec
        self.monocular = MonocularModule(spec.monocular).to(memory_format=torch.channels_last)
        self.policy = TrainableNetwork(spec.policy).requires_grad_(False)
        self.register_buffer("_rays_B", torch.from_numpy(rays_B()).flatten(0, 1), persistent=False)

    def encode(self, color: Tensor, R_HB: Tensor) -> Tensor:
        """Encodes colors (N, 90, 160, 3) and rays at R_HB (N, 3, 3) as `encode_view` does."""
        rays_H = (R_HB @ self._rays_B.mT).unflatten(2, (HEIGHT, WIDTH))
        return torch.cat([encode_color(color), rays_H], 1)

    def see(self, view: Tensor, bfloat16: bool) -> tuple[Tensor, Tensor]:
        """Computes the policy's images (N, 1 + F, 9, 16), whose first channel is the inverse depth,
        and the logarithms of its errors (N, 9, 16), -4 to 3, from views."""
        with torch.autocast(view.device.type, torch.bfloat16, enabled=bfloat16):
            found = self.monocular(view.contiguous(memory_format=torch.channels_last))
        inverse, log_error, features = found.float().split([1, 1, found.shape[1] - 2], 1)
        image = torch.cat([inverse, nn.functional.leaky_relu(features, LEAK)], 1)
        return image, log_error[:, 0].clamp(-4.0, 3.0)


def flip(view: Tensor, which: Tensor) -> Tensor:
    """Flips views (N, 6, H, W), and their rays, horizontally where `which` (N,)."""
    sign = torch.ones(view.shape[1], device=view.device)
    sign[4] = -1.0
    return torch.where(which[:, None, None, None], view.flip(3) * sign[:, None, None], view)


def laplace_loss(inverse: Tensor, log_error: Tensor, target: Tensor) -> Tensor:
    """Computes the mean negative log-likelihood of grids (N, 9, 16), less ln 2."""
    return ((inverse - target).abs() * torch.exp(-log_error) + log_error).mean()


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
    noise: ObservationNoise = field(default_factory=color_noise)

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
        spec, shards = self.spec.policy, Progress(self._data.shards, "reading depth", unit="shard")
        parts = [
            pool_depth(shard.arrays["depth"][:, self._rows()], spec.image_height, spec.image_width)
            for shard in shards
        ]
        # (N, 9, 16) [m] minimum depths in the cells of all samples
        self._targets = torch.from_numpy(np.concatenate(parts, dtype=np.float32)).to(config.device)

    def losses(self) -> dict[str, Tensor]:
        config, generator = self._config, self.generator
        color, R_HB, target = self._samples(self._data.draw(config.batch, generator))
        color = change_appearance(color, config.appearance, generator)
        color = noisy_color(color, config.noise, generator)
        flipped = torch.rand(config.batch, generator=generator, device=config.device) < 0.5
        view = flip(self.network.encode(color, R_HB), flipped)
        target = torch.where(flipped[:, None, None], target.flip(2), target)
        image, log_error = self.network.see(view, config.bfloat16)
        return {"likelihood": laplace_loss(image[:, 0], log_error, target)}

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Measures `metrics` on images without noise of held-out worlds."""
        rows = []
        for indices in self._validation:
            color, R_HB, target = self._samples(indices)
            image, _ = self.network.see(self.network.encode(color, R_HB), self._config.bfloat16)
            rows.append((image[:, 0], target))
        predicted, target = (torch.cat(part) for part in zip(*rows, strict=True))
        z = 3.0 / (target + 0.6)
        z_predicted = 3.0 / (predicted + 0.6).clamp(3.0 / MAX_DEPTH, 3.0 / MIN_DEPTH)
        close = (z_predicted / z - 1.0).abs() < _CLOSE
        return {
            "success": float(close[z < _NEAR].float().mean()),
            "missed": float((z_predicted > 5.0)[z < 3.0].float().mean()),
            "error": float((predicted - target).abs().mean()),
        }

    def _samples(self, indices: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Reads colors (N, 90, 160, 3), R_HB (N, 3, 3) and maximum inverse depths (N, 9, 16)."""
        color = torch.from_numpy(self._data.pixels(indices, "color")[:, self._rows()])
        R_WB = rotation_matrices(self._data.labels(indices).X_WB[:, :4])
        R_WH = heading_frame(torch.atan2(R_WB[:, 1, 0], R_WB[:, 0, 0]))
        target = inverse_depth(self._targets[torch.from_numpy(indices)], MIN_DEPTH, MAX_DEPTH)
        return color.to(self._config.device).float(), R_WH.mT @ R_WB, target

    def _rows(self) -> slice:
        first = (self._data.camera.height - HEIGHT) // 2
        return slice(first, first + HEIGHT)


_ACCELERATION = 2.0  # [m/s^2] where Huber's loss of the decisions changes from squares
# Decisions where something is nearer than 2 m count twice.
_NEAR_INVERSE = float(inverse_depth(np.float64(2.0), MIN_DEPTH, MAX_DEPTH))


@dataclass
class DistillationLoss:
    """Weights of the terms of the loss."""

    # [-] Huber's loss of the difference to the teacher's accelerations.
    imitation: float = 1.0
    # [-] Negative logarithm of the likelihood of the teacher's grid.
    likelihood: float = 0.5
    # [-] Factor of DiffAero's loss through the dynamics.
    dynamics: float = bounded(1.0, "[0, inf)")
    # DiffAero's loss.
    flight: DiffAeroLoss = field(default_factory=DiffAeroLoss)


@dataclass
class DistilledRgbTraining(RolloutTraining):
    """A training run of `distilled_rgb`."""

    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            updates=6000, validate_every=500, learning_rate=2e-4, decay=0.7, weight_decay=1e-3
        )
    )
    rollout: RolloutConfig = field(
        default_factory=lambda: RolloutConfig(
            environments=24, steps=16, speed=[1.5, 3.5], longest=20.0, noise=ObservationNoise()
        )
    )
    validation: FlightConditions = field(
        default_factory=lambda: FlightConditions(speeds=[2.0, 3.0], body_rate=True)
    )
    loss: DistillationLoss = field(default_factory=DistillationLoss)
    # File of weights of diffaero_rgb or distilled_rgb to begin with; those shipped of the first if
    # empty.
    begin: str = ""
    # File of DiffAero's weights; the shipped ones if empty.
    teacher: str = ""
    # [-] Maximum strength of random appearances of worlds, see `appearance` of scenarios.
    repaint: float = bounded(0.6, "[0, 1]")
    # [px] `merged_spread` of the camera in training.
    merged_spread: float = bounded(0.7, "[0, inf) px")
    # Computes the image's layers in bfloat16, which is several times as fast on processors that
    # have it.
    bfloat16: bool = False
    # Changes of the appearance of each image.
    appearance: Appearance = field(default_factory=lambda: Appearance(hue=0.0))
    # Noise of images.
    noise: ObservationNoise = field(default_factory=color_noise)

    def check(self) -> None:
        super().check()
        check_noise(self.noise, color=True, time=False)
        require_field(self, "empty", self.empty == 0.0, "0: images show the obstacles")


class DistilledRgbModule(DiffAeroRgbModule):
    """Both networks of `distilled_rgb`; the policy's weights of features are zero at first."""

    def __init__(self, begin: str = "") -> None:
        super().__init__(DISTILLED_RGB_NETWORK)
        if begin and checkpoint_policy(begin) == "distilled_rgb":
            load_weights(self, PolicyCheckpoint.load(begin, "distilled_rgb", self.spec))
            return
        checkpoint = PolicyCheckpoint.load(begin, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
        state = self.state_dict()
        state["policy.convolutions.0.weight"].zero_()
        for name, weights in checkpoint.weights.items():
            given = torch.from_numpy(weights)
            state[name][tuple(slice(size) for size in given.shape)] = given
        self.load_state_dict(state)


class DistilledRgbLearner(DiffAeroLearner):
    """Flies by RGB, and collects the teacher's decisions while it learns. A row of the memory has
    the hidden state; the same with gradients of the images alone; the teacher's; and -1 if the
    world is flipped, else 1, or 0 before the first image."""

    def __init__(self, config: DistilledRgbTraining) -> None:
        super().__init__(config.loss.flight, config.device)
        teacher = PolicyCheckpoint.load(config.teacher, "diffaero", DIFFAERO_NETWORK)
        load_weights(self.network, teacher)
        self._teacher = self.network.requires_grad_(False)
        self.network = DistilledRgbModule(config.begin).requires_grad_(True).to(config.device)
        self._config = config
        self.generator = torch.Generator(config.device).manual_seed(config.seed + 1)
        self._terms: list[tuple[Tensor, Tensor]] = []

    def initial_memory(self, count: int) -> Tensor:
        size = 3 * self.network.spec.policy.hidden_size + 1
        return torch.zeros(count, size, device=self._limits.device)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        config, network, vehicle = self._config, self.network, seen.vehicle
        learning = torch.is_grad_enabled()
        size = network.spec.policy.hidden_size
        hidden, of_images, of_teacher, sign = memory.split([size, size, size, 1], 1)
        drawn = torch.ones_like(sign)
        if learning:
            drawn[1::2] = -1.0
        sign = torch.where(sign == 0.0, drawn, sign)
        flipped, mirror = sign[:, 0] < 0.0, torch.cat([drawn.abs(), sign, drawn.abs()], 1)

        assert seen.color is not None  # for type checkers
        color = seen.color.float()
        if learning:
            color = change_appearance(color, config.appearance, self.generator)
            color = noisy_color(color, config.noise, self.generator)
        R_WH, R_WB = heading_frame(vehicle.yaw), vehicle.attitude().detach()
        view = flip(network.encode(color, R_WH.mT @ R_WB), flipped)
        image, log_error = network.see(view, config.bfloat16)

        p, v, z = vehicle.p, vehicle.v, vehicle.body_z()
        state = heading_observation(p, v, z, seen.p_WG, seen.speed, R_WH)
        mirrored = (state.unflatten(1, (3, 3)) * mirror[:, None]).flatten(1)
        output, hidden = network.policy(image, mirrored, hidden)
        command_H = limit_smoothly(output, self._limits) * mirror
        if learning:
            output, of_images = network.policy(image, mirrored.detach(), of_images)
            decided = limit_smoothly(output, self._limits) * mirror
            grid = self.encode(seen.depth)
            with torch.no_grad():
                output, of_teacher = self._teacher(grid, state, of_teacher)
                taught = limit_smoothly(output, self._limits)
            target = torch.where(flipped[:, None, None], grid.flip(2), grid)
            difference = (decided - taught) / _ACCELERATION
            zero = torch.zeros_like(difference)
            huber = nn.functional.smooth_l1_loss(difference, zero, reduction="none").sum(1)
            weight = 1.0 + (target.amax((1, 2)) > _NEAR_INVERSE)
            imitation = (huber * weight).mean() / weight.mean()
            self._terms.append((imitation, laplace_loss(image[:, 0], log_error, target)))
        memory = torch.cat([hidden, of_images, of_teacher, sign], 1)
        return (R_WH @ command_H[:, :, None])[:, :, 0], None, memory

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        weights = self._config.loss
        imitation, likelihood = (
            torch.stack(part).mean() for part in zip(*self._terms, strict=True)
        )
        self._terms.clear()
        flight = super().losses(transitions)
        return {
            "imitation": weights.imitation * imitation,
            "likelihood": weights.likelihood * likelihood,
            **{name: weights.dynamics * term for name, term in flight.items()},
        }


class DistilledRgbTrainer(RolloutTrainer):
    """Trains `distilled_rgb`."""

    def __init__(self, config: DistilledRgbTraining) -> None:
        learner = DistilledRgbLearner(config)
        super().__init__("distilled_rgb", learner, config)
        digest = blake2b(digest_size=16)
        for file, shipped in ((config.begin, "diffaero_rgb"), (config.teacher, "diffaero")):
            digest.update(Path(file or shipped_weights(shipped)).read_bytes())
        self.learns_from += digest.hexdigest()
        selection, self._repaint = config.worlds, config.repaint
        camera = replace(DistilledRgbConfig().camera, merged_spread=config.merged_spread)
        first = first_training_seed(config.seed)
        self._views = WorldViews(selection, selection.count, first, camera)
        self.worlds.views = self._views
        held_out = WorldViews(selection, selection.held_out, VALIDATION_SEEDS, camera)
        self._validation.views = held_out

    def begin_update(self, update: int) -> None:
        super().begin_update(update)
        if self._repaint:
            self._views.repaint(self._repaint, self.generator)

    def state_dict(self) -> dict[str, Any]:
        learner = self.agent.generator.get_state()
        return super().state_dict() | {"looks": self._views.looks, "noise": learner}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._views.restore(state["looks"])
        self.agent.generator.set_state(state["noise"])
        super().load_state_dict(state)
