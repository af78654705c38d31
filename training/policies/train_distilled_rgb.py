"""Trains a policy of RGB in flight, where it flies itself, by a teacher that sees depth.

Point masses fly through generated and captured worlds by the student's decisions from rendered
images. The teacher, DiffAero, decides from the depth of the same camera, with a memory of its own
along the student's flight: DAgger (Ross, Gordon and Bagnell, 2011) without a phase in which the
teacher flies. The loss has the difference of both decisions, the likelihood of the teacher's depth
grid, and DiffAero's loss through the dynamics, in which images are constant. Every second vehicle
flies in the mirror image of its world; the appearance of worlds changes.
"""

import os
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydrake.math import RigidTransform, RotationMatrix
from torch import Tensor, nn

from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world_registry import make_world, scene_config
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import VALIDATION_SEEDS, first_training_seed
from splatpilot.systems.common.validation import bounded, require_field
from splatpilot.systems.policies.base import (
    heading_frame,
    heading_observation,
    inverse_depth,
    limit_smoothly,
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
    DistilledRgbConfig,
    rays_B,
)
from splatpilot.systems.policies.networks import LEAK
from splatpilot.systems.policies.student import encode_color
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BatchRenderer
from splatpilot.systems.splats.splat_camera import color_pixels
from splatpilot.training.corpus import library
from splatpilot.training.policies.augmentation import (
    Appearance,
    change_appearance,
    check_noise,
    noisy_color,
)
from splatpilot.training.policies.evaluation import FlightConditions, camera_poses
from splatpilot.training.policies.networks import load_weights
from splatpilot.training.policies.rollouts import (
    RolloutConfig,
    RolloutTrainer,
    RolloutTraining,
    Transitions,
)
from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
from splatpilot.training.policies.train_diffaero_rgb import DiffAeroRgbModule, flip
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.training_worlds import WorldSelection, world_turns
from splatpilot.training.policies.vehicles import Observation, Vehicle

_ACCELERATION = 2.0  # [m/s^2] where Huber's loss of the decisions changes from squares
# Decisions where something is nearer than 2 m count twice.
_NEAR = float(inverse_depth(np.float64(2.0), MIN_DEPTH, MAX_DEPTH))


class WorldViews:
    """The Gaussians of the worlds of a `WorldBatch`, seen by the vehicles' cameras.

    Args:
        count, first: number of worlds, and the seed of the first, as in `training_worlds`.
        camera: its `merged_spread` may be larger in training than in flight.
    """

    def __init__(
        self, selection: WorldSelection, count: int, first: int, camera: OnboardCamera
    ) -> None:
        scenes = {
            scene: make_world(scene_config(library.training_scene(scene)), seed=0)
            for scene in selection.scenes
        }
        turns = Progress(world_turns(selection, count, first), "rendering worlds", unit="world")
        self._worlds = [
            scenes.get(turn) or make_world(library.scenario_world(turn), seed)
            for seed, turn in turns
        ]
        self._seen = list(self._worlds)
        # (W, 2), seed and strength of each appearance; a strength of 0 is the world's own.
        self.looks = torch.zeros(count, 2, dtype=torch.float64)
        self._camera, self._renderer = camera, BatchRenderer(os.cpu_count() or 1)

    def repaint(self, strength: float, generator: torch.Generator) -> None:
        """Gives a random world another appearance, of a strength up to `strength`."""
        drawn = torch.rand(3, generator=generator, dtype=torch.float64, device=generator.device)
        world, seed, part = drawn.tolist()
        index = int(world * len(self._worlds))
        self.looks[index, 0], self.looks[index, 1] = int(seed * 2**31), part * strength
        self._paint(index)

    def restore(self, looks: Tensor) -> None:
        """Restores the appearances `looks`."""
        self.looks = looks
        for index in looks[:, 1].nonzero()[:, 0].tolist():
            self._paint(index)

    def _paint(self, index: int) -> None:
        seed, strength = self.looks[index].tolist()
        self._seen[index] = randomize_appearance(self._worlds[index], strength, int(seed))

    @torch.no_grad()
    def render(self, vehicle: Vehicle, world: Tensor) -> Tensor:
        """Renders colors (N, H, W, 3), uint8, from the vehicles' cameras, each in its `world`
        (N,)."""
        poses = (part.double().cpu().numpy() for part in camera_poses(vehicle))
        X_WCs = [
            RigidTransform(RotationMatrix.ProjectToRotationMatrix(R_WC), p_WC)
            for p_WC, R_WC in zip(*poses, strict=True)
        ]
        worlds = [self._seen[index] for index in world.tolist()]
        info = self._camera.camera_info()
        color = self._renderer.render_color(
            [world.baked for world in worlds],
            info.intrinsic_matrix(),
            info.width(),
            info.height(),
            X_WCs,
            backgrounds=[world.background for world in worlds],
            merged_spread=self._camera.merged_spread,
        )
        return torch.from_numpy(color_pixels(color)).to(world.device)


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
    noise: ObservationNoise = field(
        default_factory=lambda: ObservationNoise(color_noise=0.02, brightness_jitter=0.2)
    )

    def check(self) -> None:
        super().check()
        check_noise(self.noise, color=True, time=False)
        require_field(self, "empty", self.empty == 0.0, "0: images show the obstacles")


class DistilledRgbModule(DiffAeroRgbModule):
    """Both networks of `distilled_rgb`; the policy's weights of features are zero at first."""

    def __init__(self, begin: str = "") -> None:
        super().__init__(DISTILLED_RGB_NETWORK)
        self.spec = DISTILLED_RGB_NETWORK
        if begin and checkpoint_policy(begin) == "distilled_rgb":
            load_weights(self, PolicyCheckpoint.load(begin, "distilled_rgb", self.spec))
            return
        checkpoint = PolicyCheckpoint.load(begin, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
        state = self.state_dict()
        first = "policy.convolutions.0.weight"
        state[first].zero_()
        for name, weights in checkpoint.weights.items():
            given = torch.from_numpy(weights)
            state[name][tuple(slice(size) for size in given.shape)] = given
        self.load_state_dict(state)

    def see(self, view: Tensor, bfloat16: bool) -> tuple[Tensor, Tensor]:
        """Computes the policy's images (N, 1 + F, 9, 16) and the logarithms of errors (N, 9, 16)
        from views (N, 6, 90, 160)."""
        with torch.autocast(view.device.type, torch.bfloat16, enabled=bfloat16):
            found = self.monocular(view.contiguous(memory_format=torch.channels_last))
        inverse, log_error, features = found.float().split([1, 1, found.shape[1] - 2], 1)
        image = torch.cat([inverse, nn.functional.leaky_relu(features, LEAK)], 1)
        return image, log_error[:, 0].clamp(-4.0, 3.0)


class DistilledRgbLearner(DiffAeroLearner):
    """Flies by RGB, and collects the teacher's decisions while it learns.

    A row of the memory has the hidden state; the same with gradients of the images alone, not of
    the flight; the teacher's; and -1 if the world is flipped, else 1, or 0 before the first image.
    """

    def __init__(self, config: DistilledRgbTraining) -> None:
        super().__init__(config.loss.flight, config.device)
        teacher = PolicyCheckpoint.load(config.teacher, "diffaero", DIFFAERO_NETWORK)
        load_weights(self.network, teacher)
        self._teacher = self.network.requires_grad_(False)
        self.network = DistilledRgbModule(config.begin).requires_grad_(True).to(config.device)
        self._config = config
        self._rays_B = torch.from_numpy(rays_B()).flatten(0, 1).to(config.device)
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
        rays = ((R_WH.mT @ R_WB) @ self._rays_B.mT).unflatten(2, (HEIGHT, WIDTH))
        view = flip(torch.cat([encode_color(color), rays], 1), flipped)
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
            self._terms.append(_compare(decided, taught, image[:, 0], log_error, target))
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


def _compare(
    decided: Tensor, taught: Tensor, inverse: Tensor, log_error: Tensor, target: Tensor
) -> tuple[Tensor, Tensor]:
    """Computes the terms of decisions (N, 3) and of grids (N, 9, 16)."""
    difference = (decided - taught) / _ACCELERATION
    huber = nn.functional.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none")
    weight = 1.0 + (target.amax((1, 2)) > _NEAR)
    error = (inverse - target).abs()
    likelihood = (error * torch.exp(-log_error) + log_error).mean()
    return (huber.sum(1) * weight).mean() / weight.mean(), likelihood


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
