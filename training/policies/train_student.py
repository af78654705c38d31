"""Trains the student: imitation of an expert's trajectories from images of a corpus.

After the paper, Sec. III-B: MobileNetV2 from ImageNet encodes an RGB or depth image; layers encode
velocity and direction to the goal in the body frame; a head predicts three hypotheses of ten
waypoints at 0.1 s with a cost each. The loss is relaxed winner-takes-all, and costs of error and
clearance (equation 4). `docs/reproduction.md` lists the differences from the paper.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from itertools import chain
from math import ceil
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.diagrams.worlds.scene_folder import SceneSource
from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import require_writable_folder, written_atomically
from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.common.readers import error_summary
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
from splatpilot.training.corpus.corpus import (
    RECOVERY,
    SHARD,
    Corpus,
    Shard,
    distinct_shards,
    distinct_worlds,
)
from splatpilot.training.corpus.library import WorldRecord, require_untested
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
from splatpilot.training.policies.ray_casting import EsdfGeometry
from splatpilot.training.policies.trainer import CorpusTraining, Schedule, Trainer

_CHANCES = 1 << 20  # resolution of random choices
_BATCH = 8  # Images encoded at once, whose activations fit a processor's caches.


class Labels(NamedTuple):
    """Labels of N samples, float32, in the body frame B; see `Samples`."""

    X_WB: Tensor  # (N, 7) quaternion wxyz and position [m]
    v_B: Tensor  # (N, 3) [m/s]
    goal_B: Tensor  # (N, 3) [m]
    trajectories_B: Tensor  # (N, K, 10, 3) [m]
    world: Tensor  # (N,) int64, index into `StudentData.worlds`


class StudentData:
    """Holds the distinct samples of corpora, with held-out worlds; images stay on disk."""

    def __init__(self, corpora: Sequence[Corpus], held_out: float, device: str = "cpu") -> None:
        first = corpora[0].config
        self.camera, self.speed = first.camera, first.expert.speed
        for corpus in corpora:
            config, remedy = corpus.config, "collect them with the same"
            for what, ours, other in (
                ("cameras", first.camera, config.camera),
                ("numbers of trajectories", first.size.trajectories, config.size.trajectories),
                ("speeds of the expert", first.expert.speed, config.expert.speed),
            ):
                found = f"{ours} and {other}"
                require(ours == other, f"{what} of the corpora", "equal", found, remedy)
            valid, found = not config.worlds.held_out, "one of worlds.held_out"
            require(valid, f"{corpus.folder}", "a corpus to train with", found, "collect another")
        self._records = distinct_worlds(corpora)
        for record in self._records.values():
            if isinstance(record.source.world, SceneSource):
                require_untested(record.source.source_digest, str(record.path))
        self.worlds = sorted(self._records)  # names
        self.held_out_worlds = held_out_worlds(self._records, held_out)
        self.shards = [shard for shard in chain(*distinct_shards(corpora)) if len(shard)]
        counts = [len(shard) for shard in self.shards]
        self.first = np.cumsum([0, *counts])  # index of the first sample of each shard
        index = {name: k for k, name in enumerate(self.worlds)}
        world = np.repeat([index[shard.world] for shard in self.shards], counts)
        outside = np.isin(world, [index[name] for name in self.held_out_worlds])
        recovered = np.repeat([shard.source == RECOVERY for shard in self.shards], counts)
        # Indices of samples; those recovered are from flights of students, those shown are not.
        self.training, self.held_out = np.flatnonzero(~outside), np.flatnonzero(outside)
        self.recovered = np.flatnonzero(~outside & recovered)
        self._shown = np.flatnonzero(~outside & ~recovered)
        if not (len(self.training) and len(self.held_out)):
            smallest = ceil(100 * min(map(rank, _environments(self._records).values()))) / 100
            raise ValueError(
                f"{len(self.held_out_worlds)} of {len(self.worlds)} worlds are held out, which "
                f"leaves {len(self.training)} samples to train with and {len(self.held_out)} to "
                f"validate with; collect in more worlds, or set held_out to {smallest} or more"
            )

        labels = [
            torch.from_numpy(np.concatenate([s.arrays[name] for s in self.shards])).float()
            for name in ("X_WB", "v_B", "goal_B", "trajectories_B")
        ]
        self._labels = Labels(*(part.to(device) for part in (*labels, torch.from_numpy(world))))

    def digest(self, *files: str) -> str:
        """Computes a digest of the samples, their split and the content of files."""
        digest = blake2b(digest_size=16)
        for shard in self.shards:
            digest.update(shard.path.name.encode() + (shard.path / SHARD).read_bytes())
        digest.update(" ".join(self.held_out_worlds).encode())
        for file in filter(None, files):
            digest.update(Path(file).read_bytes())
        return digest.hexdigest()

    def draw(self, count: int, generator: torch.Generator, recovery_share: float = 0) -> np.ndarray:
        """Draws training samples (count,), `recovery_share` of them of recovery; any if it is 0."""

        def integers(limit: int) -> np.ndarray:
            drawn = torch.randint(limit, (count,), generator=generator, device=generator.device)
            return drawn.cpu().numpy()

        if not (recovery_share and len(self.recovered)):
            return self.training[integers(len(self.training))]
        recovered, shown = (g[integers(len(g))] for g in (self.recovered, self._shown))
        return np.where(integers(_CHANCES) < recovery_share * _CHANCES, recovered, shown)

    def labels(self, indices: np.ndarray) -> Labels:
        """Returns the labels of samples (N,)."""
        chosen = torch.from_numpy(indices).to(self._labels.world.device)
        return Labels(*(values[chosen] for values in self._labels))

    def pixels(self, indices: np.ndarray, name: str) -> np.ndarray:
        """Reads the images `color` or `depth` of samples (N,), see `Samples`."""
        return np.stack([self.shards[k].arrays[name][row] for k, row in self.locate(indices)])

    def locate(self, indices: np.ndarray) -> Iterator[tuple[int, int]]:
        """Yields the shard of each sample (N,) and its index there."""
        shard = np.searchsorted(self.first, indices, side="right") - 1
        return zip(shard, indices - self.first[shard], strict=True)

    def distance_along(self, waypoints_B: Tensor, labels: Labels) -> Tensor:
        """Computes distances (N, M, T) [m] at waypoints (N, M, T, 3) [m], differentiable."""
        N, M, T, _ = waypoints_B.shape
        R_WB, p_WB = rotation_matrices(labels.X_WB[:, :4]), labels.X_WB[:, None, 4:]
        p_WQ = (waypoints_B.flatten(1, 2) @ R_WB.mT + p_WB).flatten(0, 1)
        world = labels.world.repeat_interleave(M * T)
        distances, gradients = self._fields.interpolate(p_WQ.detach(), world)
        along = (gradients * (p_WQ - p_WQ.detach())).sum(1)
        return (distances + along).reshape(N, M, T)

    @cached_property
    def _fields(self) -> EsdfGeometry:
        """Distances in all worlds; unknown space is occupied, as for the expert."""
        fields = [self._records[name].esdf for name in self.worlds]
        return EsdfGeometry([f if f.occupied_outside else f.conservative() for f in fields])


def held_out_worlds(records: Mapping[str, WorldRecord], fraction: float) -> list[str]:
    """Returns the worlds, in order, of the `fraction` that validate: by the `rank` of their name,
    or of the source of their scene if there are others, so that corpora may grow."""
    environments = _environments(records)
    return [name for name in sorted(records) if rank(environments[name]) < fraction]


def _environments(records: Mapping[str, WorldRecord]) -> dict[str, str]:
    """Returns the source of the scene of each world, or else its name."""
    sources = {name: "".join(record.source.source_digest) for name, record in records.items()}
    one_scene = len(set(sources.values())) == 1
    return {name: name if one_scene else source or name for name, source in sources.items()}


def rank(name: str) -> float:
    """Computes a number in [0, 1] from a name; less than the fraction is held out."""
    return int.from_bytes(blake2b(name.encode()).digest()[:8]) / 2**64


def encode_images(images: Tensor) -> Tensor:
    """Encodes colors (N, H, W, 3), 0 to 255, or depth (N, H, W) [m] as (N, 3, H, W)."""
    return encode_color(images) if images.ndim == 4 else encode_depth(images)


class FrozenFeatures:
    """Outputs of the network's first `frozen` modules for all samples, computed once. The file of a
    shard is named by a digest of images and weights, so that runs share files."""

    def __init__(
        self, folder: Path, data: StudentData, network: StudentModule, frozen: int
    ) -> None:
        require_writable_folder(folder)
        self._data, self._network, self._frozen = data, network, frozen
        key = blake2b(network.spec.observation.encode(), digest_size=16)
        for values in network.image_modules(frozen).parameters():
            key.update(values.detach().cpu().numpy().tobytes())
        self._files = []
        for shard in Progress(data.shards, f"encoding by {frozen} frozen modules", unit="shard"):
            digest = key.copy()
            digest.update((shard.path / SHARD).read_bytes())
            self._files.append(self._open(folder / f"{digest.hexdigest()}.npy", shard))

    def __call__(self, indices: np.ndarray) -> Tensor:
        """Reads the features (N, ...) of samples (N,)."""
        rows = [self._files[k][within] for k, within in self._data.locate(indices)]
        return torch.from_numpy(np.stack(rows)).float()

    def _open(self, file: Path, shard: Shard) -> np.ndarray:
        try:
            return np.load(file, mmap_mode="r")
        except FileNotFoundError:
            pass
        except (ValueError, EOFError) as error:
            say(f"{file} is damaged ({error_summary(error)}): it is computed again")
            file.unlink()
        pixels, features = shard.arrays[self._network.spec.pixels], []
        device = next(self._network.parameters()).device
        with torch.no_grad(), written_atomically(file) as path:
            for first in range(0, len(pixels), _BATCH):
                images = torch.from_numpy(np.array(pixels[first : first + _BATCH])).to(device)
                images = encode_images(images.float())
                encoded = self._network.encode_image(images, 0, self._frozen)
                features.append(encoded.half().cpu().numpy())
            np.save(path, np.concatenate(features))
        return np.load(file, mmap_mode="r")


_VALIDATED = 2000  # held-out samples, evenly spaced, that are evaluated


class CorpusTrainer(Trainer):
    """Base class of trainers on the samples of corpora; `config` is a `CorpusTraining`."""

    def __init__(self, config: Any) -> None:
        self._config = config
        corpora = [Corpus(Path(path)) for path in config.corpora]
        self._data = StudentData(corpora, config.held_out, config.device)
        self.generator = torch.Generator(config.device).manual_seed(config.seed)
        indices = self._data.held_out
        count = min(_VALIDATED, len(indices))
        spaced = indices[np.linspace(0, len(indices) - 1, count).astype(int)]
        self._validation = [spaced[n : n + config.batch] for n in range(0, count, config.batch)]


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
    """Computes L_m (..., M) = 10 / (3 T) sum_t |T*_t - T_mt|^2 [m^2] of T* (..., T, 3) [m], the
    expert's, and T_m (..., M, T, 3) [m]."""
    squares = (expert.unsqueeze(-3) - waypoints).square().sum((-2, -1))
    return 10.0 / (3 * expert.shape[-2]) * squares


def imitation_terms(errors: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """Computes the relaxed winner-takes-all loss: the terms of the closest and of the others.
    mean_n (1 - epsilon) min_m L_m and mean_n epsilon / (M - 1) (sum_m L_m - min_m L_m)."""
    closest = errors.min(1).values
    others = (errors.sum(1) - closest) / max(errors.shape[1] - 1, 1)
    return (1.0 - epsilon) * closest.mean(), epsilon * others.mean()


def penalties(errors: Tensor, distances: Tensor) -> Tensor:
    """Computes u_m (N, M) = L_m + GEOMETRIC_WEIGHT g_m of equation 4; g integrates the soft barrier
    of equation 3 over the trajectory by signed distances (N, M, T) [m]."""
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
            shapes = self.spec.weight_shapes()
            begin = load_checkpoint(config.begin, config.observation)
            weights = begin.build(lambda _, weights: check_weights(weights, shapes))
            self.network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        elif config.pretrained:
            self.network.load_state_dict(imagenet_weights(), strict=False)
        self.learns_from = self._data.digest(config.begin)
        self.network.image_modules(config.frozen).requires_grad_(False)
        # Convolutions on a CPU take a third less time with the channels last.
        self.network.to(config.device).to(memory_format=torch.channels_last)
        features = Path(config.features), self._data, self.network, config.frozen
        self._features = FrozenFeatures(*features) if config.frozen else None

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
        if augmented and config.appearance != Appearance(0.0, 0.0):
            images = change_appearance(images, config.appearance, generator)
        if augmented and config.noise != ObservationNoise():
            add_noise = noisy_depth if config.observation == "depth" else noisy_color
            images = add_noise(images, config.noise, generator)
        return encode_images(images)

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
