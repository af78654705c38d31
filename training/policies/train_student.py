"""Trains the student: imitation of an expert's trajectories from images of a corpus.

After the paper, Sec. III-B: MobileNetV2 from ImageNet encodes an RGB or depth image; layers encode
velocity and direction to the goal in the body frame; a head predicts three hypotheses of ten
waypoints at 0.1 s with a cost each. The loss is relaxed winner-takes-all, and costs of error and
clearance (equation 4). `docs/reproduction.md` lists the differences from the paper.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.validation import bounded, require, require_field
from splatpilot.systems.policies.checkpoint import check_weights
from splatpilot.systems.policies.hypotheses import WAYPOINT_PERIOD
from splatpilot.systems.policies.student import (
    StudentSpec,
    encode_color,
    encode_depth,
    encode_state,
    load_checkpoint,
)
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.policies.augmentation import (
    Appearance,
    change_appearance,
    check_noise,
    noisy_color,
    noisy_depth,
)
from splatpilot.training.policies.networks import (
    IMAGE_MODULES,
    StudentModule,
    imagenet_weights,
)
from splatpilot.training.policies.student_data import CorpusTrainer, FrozenFeatures
from splatpilot.training.policies.trainer import CorpusTraining, Schedule

GEOMETRIC_WEIGHT = 1.0  # [1/(m s)] weight of the barrier in equation 4
COST_WEIGHT = 0.1  # [-] weight of the costs' error
CLEARANCE_CAP = 0.8  # [m] of the vehicle's center, beyond which more is not rewarded
CLOSE = 0.25  # [m] root mean square distance to the expert's trajectory, for success


@dataclass
class StudentTraining(CorpusTraining):
    """A training run of a student."""

    observation: ClassVar[str]
    """Kind of images: rgb or depth."""

    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            updates=4000, validate_every=1000, checkpoint_every=500, learning_rate=5e-4, decay=0.5
        )
    )
    # Begins with ImageNet's weights of the encoder, instead of from scratch.
    pretrained: bool = True
    # [-] Number of first modules that keep their weights, of the 19 of the encoder and the layer of
    # its cells. Their outputs are computed once.
    frozen: int = bounded(7, f"[0, {IMAGE_MODULES}]")
    # Folder of the outputs of frozen modules, which runs share.
    features: str = "out/features"
    # [-] Fraction of each step's samples from flights of students; 0 for as many as there are.
    recovery_share: float = bounded(0.0, "[0, 1]")
    # [-] Fraction of the expert's pull that the hypotheses share that are not the closest.
    epsilon: float = bounded(0.05, "[0, 0.5]")
    # [-] Weight of the shortfall of clearance from the expert's; 0 as published.
    clearance_weight: float = bounded(0.0, "[0, inf)")
    appearance: Appearance = field(default_factory=lambda: Appearance(exposure=0.0, hue=0.0))

    def check(self) -> None:
        super().check()
        depth = self.observation == "depth"
        check_noise(self.noise, depth=depth, color=not depth, time=False)
        unchanged = self.appearance == Appearance(0.0, 0.0)
        require_field(self, "appearance", unchanged or not depth, "left out of training from depth")
        fixed = unchanged and self.noise == ObservationNoise()
        require_field(self, "frozen", fixed or not self.frozen, "0 with noise or appearance")
        if not self.begin:
            limit = IMAGE_MODULES - 1 if self.pretrained else 0
            condition = f"at most {limit} without `begin`, as further modules are untrained"
            require_field(self, "frozen", self.frozen <= limit, condition)


@dataclass
class StudentRgbTraining(StudentTraining):
    """A training run of a student that sees RGB."""

    observation = "rgb"


@dataclass
class StudentDepthTraining(StudentTraining):
    """A training run of a student that sees depth."""

    observation = "depth"

    clearance_weight: float = bounded(5.0, "[0, inf)")


def hypothesis_errors(expert: Tensor, waypoints: Tensor) -> Tensor:
    """Computes L_m (N, M) = 10 / (3 T) sum_t |T*_t - T_mt|^2 [m^2] of T* (N, T, 3) [m], the
    expert's, and T_m (N, M, T, 3) [m]."""
    return 10.0 / (3 * expert.shape[1]) * (expert[:, None] - waypoints).square().sum((2, 3))


def imitation_terms(errors: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """Computes the relaxed winner-takes-all loss: the terms of the closest and of the others.
    mean_n (1 - epsilon) min_m L_m and mean_n epsilon / (M - 1) (sum_m L_m - min_m L_m)."""
    closest = errors.min(1).values
    others = (errors.sum(1) - closest) / max(errors.shape[1] - 1, 1)
    return (1.0 - epsilon) * closest.mean(), epsilon * others.mean()


def penalties(errors: Tensor, distances: Tensor) -> Tensor:
    """Computes u_m (N, M) = L_m + GEOMETRIC_WEIGHT g_m of equation 4, with the errors L_m to the
    expert's best trajectory alone; g is the soft barrier of equation 3, integrated over the
    trajectory by signed distances (N, M, T) [m]."""
    barrier = WAYPOINT_PERIOD * soft_barrier(distances, VEHICLE_RADIUS).sum(2)
    return errors + GEOMETRIC_WEIGHT * barrier


def cost_targets(penalties: Tensor) -> Tensor:
    """Computes c*_m (N, M) = u_m / (mean u + eta) of equation 4."""
    return penalties / (penalties.mean(1, keepdim=True) + 1e-6)


def missing_clearances(distances: Tensor, expert: Tensor) -> Tensor:
    """Computes C_m (N, M) = 10 / (3 T) sum_t max(0, min(d*_t, CLEARANCE_CAP) - d_mt)^2 [m^2] of
    signed distances d (N, M, T) [m] and the expert's, d* (N, T) [m]."""
    missing = (expert.clamp(max=CLEARANCE_CAP)[:, None] - distances).clamp(min=0.0)
    return 10.0 / (3 * distances.shape[2]) * missing.square().sum(2)


class _Prediction(NamedTuple):
    """Hypotheses of N samples and their errors."""

    costs: Tensor  # (N, M)
    errors: Tensor  # (N, M) [m^2]
    distances: Tensor  # (N, M, T) [m], to the nearest surface
    penalties: Tensor  # (N, M), without gradient


class StudentTrainer(CorpusTrainer):
    """Trains a student on the samples of corpora."""

    evaluated = "samples"
    metrics = f"""\
Of samples, not of flights. The hypothesis of minimum predicted cost is chosen; `success` is the
fraction in which it keeps the vehicle's radius clear and stays within {CLOSE} m, root mean square,
of the expert's best trajectory; `clear` that in which it keeps clear; `error` [m] its mean distance
from that trajectory; `best_chosen` the fraction in which no other hypothesis has a lower penalty,
of error and clearance."""

    def __init__(self, config: StudentTraining) -> None:
        super().__init__(config)
        self.policy = f"student_{config.observation}"
        camera = self._data.camera
        size = camera.width, camera.height, camera.fov_x
        # Others are not kept with the weights.
        level = replace(camera, X_BC=OnboardCamera().X_BC, fov_y=None, distortion=None)
        condition = "level, with square pixels and without distortion"
        require(camera == level, "the camera of the corpora", condition, dump_config(camera))
        self.spec = StudentSpec(config.observation, *size, nominal_speed=self._data.speed)
        self.network = StudentModule(self.spec)
        if config.begin:
            checkpoint = load_checkpoint(config.begin, config.observation)
            shapes = self.spec.weight_shapes()
            weights = checkpoint.build(lambda _, weights: check_weights(weights, shapes))
            self.network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        elif config.pretrained:
            self.network.load_state_dict(imagenet_weights(), strict=False)
        self.learns_from = self._data.digest(config.begin)
        self.network.image_modules(config.frozen).requires_grad_(False)
        # Convolutions on a CPU take a third less time with the channels last.
        self.network.to(config.device).to(memory_format=torch.channels_last)
        self._features = None
        if config.frozen:
            folder = Path(config.features)
            self._features = FrozenFeatures(folder, self._data, self.network, config.frozen)

    def losses(self) -> dict[str, Tensor]:
        config = self._config
        indices = self._data.draw(config.batch, self.generator, config.recovery_share)
        predicted = self._predict(indices, augmented=True)
        closest, others = imitation_terms(predicted.errors, config.epsilon)
        wins = torch.bincount(predicted.errors.argmin(1), minlength=predicted.errors.shape[1])
        error = (predicted.costs - cost_targets(predicted.penalties)).square().mean()
        terms = {
            "winners": closest,
            "unvoted": others,
            "cost": COST_WEIGHT * error,
            **{f"votes_{m}": share for m, share in enumerate((wins / len(indices)).unbind())},
        }
        if config.clearance_weight:
            labels = self._data.labels(indices)
            expert = self._data.distance_along(labels.trajectories_B[:, :1], labels)[:, 0]
            missing = missing_clearances(predicted.distances, expert)
            terms["clearance"] = config.clearance_weight * missing.mean()
        return terms

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Measures `metrics` on images without noise of held-out worlds."""
        rows = []
        for indices in self._validation:
            predicted = self._predict(indices, augmented=False)
            chosen = predicted.costs.argmin(1)
            each = torch.arange(len(chosen), device=chosen.device)
            clear = (predicted.distances[each, chosen] > VEHICLE_RADIUS).all(1)
            error = (0.3 * predicted.errors[each, chosen]).sqrt()  # root mean square
            best = predicted.penalties.argmin(1) == chosen
            rows.append(torch.stack([clear & (error < CLOSE), clear, error, best], 1).float())
        means = torch.cat(rows).mean(0).tolist()
        return dict(zip(("success", "clear", "error", "best_chosen"), means, strict=True))

    def _images(self, indices: np.ndarray, augmented: bool) -> Tensor:
        config, generator = self._config, self.generator
        if self._features:
            return self._features(indices).to(config.device)
        images = torch.from_numpy(self._data.pixels(indices, self.spec.pixels))
        images = images.to(config.device).float()
        noisy = augmented and config.noise != ObservationNoise()
        if config.observation == "depth":
            return encode_depth(noisy_depth(images, config.noise, generator) if noisy else images)
        if augmented and config.appearance != Appearance(0.0, 0.0):
            images = change_appearance(images, config.appearance, generator)
        return encode_color(noisy_color(images, config.noise, generator) if noisy else images)

    def _predict(self, indices: np.ndarray, augmented: bool) -> _Prediction:
        labels = self._data.labels(indices)
        R_WB = rotation_matrices(labels.X_WB[:, :4])
        state = encode_state(R_WB, labels.v_B, labels.goal_B, self.spec.reach)
        image = self._images(indices, augmented)
        waypoints, costs = self.network(image, state, self._config.frozen)
        # The first trajectory is the cheapest, and always valid.
        errors = hypothesis_errors(labels.trajectories_B[:, 0], waypoints)
        distances = self._data.distance_along(waypoints, labels)
        return _Prediction(costs, errors, distances, penalties(errors.detach(), distances.detach()))
