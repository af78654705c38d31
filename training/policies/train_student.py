"""Training the student: imitation of an expert's trajectories from images of a corpus.

After the paper, Sec. III-B: MobileNetV2 from ImageNet encodes the image, colours or depth; layers
encode velocity and direction to the goal in the body frame; a head makes of both three hypotheses
of ten waypoints at 0.1 s with a cost each. Relaxed winner-takes-all; costs of what was predicted,
by error and by the clearance of its own way (equation 4).

Chosen here, where the paper is silent: waypoints are deviations from the unobstructed way, so that
the network need not learn to arrive; the vector to the goal is of length 1 beyond the expert's
reach of two seconds and shrinks to nothing at the goal; beside it stands which way is up. The head
has a hidden layer, unlike the paper's, unless `head_features` is 0. The encoder's 4x5 cells are
kept apart, at 64 numbers each, which are as many as the average over all cells has at 1280; depth
is encoded by its logarithm, as a grey image; the barrier is integrated over the second that is
predicted. With a `handicap` others than the first hypothesis learn only what it is far from. A
student that sees depth also learns to keep as clear as its expert, unless `clearance_weight` is 0.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.hypotheses import WAYPOINT_PERIOD
from splatpilot.systems.policies.student import StudentSpec
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.student_config import StudentTraining
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_features import FrozenFeatures
from splatpilot.training.policies.student_images import (
    Appearance,
    clean_images,
    in_a_mirror,
    training_images,
)
from splatpilot.training.policies.student_network import (
    StudentModule,
    encode_state,
    imagenet_weights,
)

# What the student learns from: relaxed winner-takes-all, and costs of what it predicts.
#
# After the paper, whose objective adapts "Learning High-Speed Flight in the Wild" (A. Loquercio et
# al., Science Robotics 2021). N samples, K experts, M hypotheses, T = 10 waypoints.


_SMALLEST = 1e-6
"""The eta of equation 4 [-], for samples in which all is perfect."""


def hypothesis_errors(experts: Tensor, waypoints: Tensor) -> Tensor:
    """L_km (N, K, M) = 10 / (3 T) sum_t |T*_kt - T_mt|^2 [m^2].

    Infinite for experts that there are not, whose waypoints are NaN; their gradient is zero.

    Args:
        experts: (N, K, T, 3) [m].
        waypoints: (N, M, T, 3) [m].
    """
    there = experts.isfinite().flatten(2).all(2)[:, :, None]
    apart = torch.where(there[..., None, None], experts[:, :, None] - waypoints[:, None], 0.0)
    errors = 10.0 / (3 * experts.shape[2]) * apart.square().sum((3, 4))
    return torch.where(there, errors, torch.inf)


def root_mean_square(errors: Tensor) -> Tensor:
    """The distance [m], root mean square over waypoints, that an error L (...) stands for."""
    return (0.3 * errors).sqrt()


def winners(errors: Tensor, handicap: float = 1.0) -> Tensor:
    """Votes (N, K, M), 1 where hypothesis m is the closest to expert k; none of experts that there
    are not.

    Args:
        errors: L (N, K, M).
        handicap: times that the errors of all hypotheses but the first count.
    """
    contending = torch.cat([errors[..., :1], handicap * errors[..., 1:]], dim=2)
    votes = torch.zeros_like(errors).scatter(2, contending.argmin(2, keepdim=True), 1.0)
    return torch.where(errors.isfinite(), votes, 0.0)


def imitation_terms(errors: Tensor, epsilon: float, handicap: float = 1.0) -> tuple[Tensor, Tensor]:
    """How far the winners are from the experts that voted for them, and what pulls the others.

        winners = mean_n sum_k (1 - epsilon) L_km of the closest m
        unvoted = mean_n sum over m without votes of epsilon / (M - 1) L_0m

    Args:
        errors: L (N, K, M); expert 0 is the best.
        epsilon: the part of the pull that the unvoted share.
        handicap: see `winners`.
    """
    votes = winners(errors, handicap)
    finite = torch.where(errors.isfinite(), errors, 0.0)
    won = (1.0 - epsilon) * (votes * finite).sum((1, 2)).mean()
    unvoted = votes.sum(1) == 0.0  # (N, M)
    share = epsilon / max(errors.shape[2] - 1, 1)
    return won, share * (unvoted * finite[:, 0]).sum(1).mean()


def missing_clearances(distances: Tensor, experts: Tensor, cap: float) -> Tensor:
    """C_m (N, M) = 10 / (3 T) sum_t (min(d*_t, cap) - d_mt)^2 [m^2] where that is positive: how
    much nearer to surfaces hypotheses are than the expert at the same time.

    Args:
        distances: d (N, M, T) [m], signed, at the waypoints.
        experts: d* (N, T) [m] at the best expert's; -inf where there is none, and nothing missing.
        cap: [m], of which more is not asked.
    """
    missing = (experts.clamp(max=cap)[:, None] - distances).clamp(min=0.0)
    return 10.0 / (3 * distances.shape[2]) * missing.square().sum(2)


def barrier_along(distances: Tensor) -> Tensor:
    """g (N, M) [m s]: the soft barrier of equation 3 integrated over trajectories.

    Args:
        distances: (N, M, T) [m], signed, at the waypoints.
    """
    return WAYPOINT_PERIOD * soft_barrier(distances, VEHICLE_RADIUS).sum(2)


def hypothesis_penalties(errors: Tensor, barriers: Tensor, geometric_weight: float) -> Tensor:
    """u_m (N, M) = min_k L_km + geometric_weight g_m, of equation 4."""
    return errors.amin(1) + geometric_weight * barriers


def cost_targets(penalties: Tensor) -> Tensor:
    """c*_m (N, M) = u_m / (mean u + eta), of equation 4; detached."""
    return (penalties / (penalties.mean(1, keepdim=True) + _SMALLEST)).detach()


def cost_error(costs: Tensor, targets: Tensor) -> Tensor:
    """The mean squared error of predicted costs (N, M)."""
    return (costs - targets).square().mean()


class StudentViews:
    """The images of a training's samples, as they are or `disturbed`, and perhaps in a mirror.

    Args:
        config: of the training.
        data: the samples.
        network: what takes the images, from its module `config.frozen` on.

    Raises:
        OSError: if the folder of features cannot be written.
    """

    def __init__(self, config: StudentTraining, data: StudentData, network: StudentModule) -> None:
        self._config, self._data, self._pixels = config, data, network.spec.pixels
        self._features = {
            (disturbed, mirrored): FrozenFeatures(
                Path(config.features),
                data,
                network,
                config.frozen,
                config.draws if disturbed else 1,
                config.appearance if disturbed else Appearance(0.0, 0.0),
                config.noise if disturbed else ObservationNoise(),
                mirrored,
            )
            for disturbed in sorted({config.disturbed > 0.0, config.disturbed == 1.0})
            for mirrored in sorted({False, config.mirrored})
            if config.frozen
        }

    def kept(
        self, numbers: np.ndarray, draws: np.ndarray, disturbed: np.ndarray, mirrored: np.ndarray
    ) -> Tensor:
        """Of samples (N,) to train with, what frozen modules made of the draws (N,) of those that
        are disturbed, and of the others as they are."""
        parts = []
        for (of_disturbed, of_mirrored), features in self._features.items():
            rows = (disturbed == of_disturbed) & (mirrored == of_mirrored)
            if rows.any():
                parts.append((rows, features(numbers[rows], draws[rows] * of_disturbed)))
        return _joined(parts).to(self._config.device)

    def anew(
        self,
        numbers: np.ndarray,
        disturbed: np.ndarray,
        mirrored: np.ndarray,
        generator: torch.Generator,
    ) -> Tensor:
        """Of samples (N,) to train with, images whose light and noise the generator draws, where
        they are disturbed."""
        config, pixels = self._config, self._data.pixels(numbers, self._pixels)
        pixels[mirrored] = in_a_mirror(pixels[mirrored])
        parts = []
        if disturbed.any():
            worse = training_images(pixels[disturbed], config.appearance, config.noise, generator)
            parts.append((disturbed, worse))
        if not disturbed.all():
            parts.append((~disturbed, clean_images(pixels[~disturbed], config.device)))
        return _joined(parts)

    def clean(self, numbers: np.ndarray) -> Tensor:
        """Of held-out samples (N,), as they are."""
        device = self._config.device
        if not self._features:
            return clean_images(self._data.pixels(numbers, self._pixels), device)
        features = next(iter(self._features.values()))
        return features(numbers, np.zeros(len(numbers), int)).to(device)


def _joined(parts: list[tuple[np.ndarray, Tensor]]) -> Tensor:
    """Parts of a batch with the rows (N,) that each is of, as one."""
    rows, first = parts[0]
    whole = first.new_empty(len(rows), *first.shape[1:])
    for rows, part in parts:
        whole[torch.from_numpy(rows)] = part
    return whole


_CLOSE = 0.25
"""[m] Root mean square distance from an expert's trajectory within which one is as good."""
_LOTS = 1 << 24
"""Of which an image draws one: those below `disturbed` of them all have it disturbed."""


class StudentTrainer:
    """See `splatpilot.training.policies.trainer.Trainer`."""

    evaluated = "samples"
    measures = f"""\
Of samples, not of flights. The hypothesis of least predicted cost is chosen; `success` is the part
in which it keeps the vehicle's radius clear and stays within {_CLOSE} m, root mean square, of a
trajectory of the expert's; `clear` that in which it keeps clear; `error` [m] its mean distance from
the nearest such trajectory; `best_chosen` the part in which none of the three hypotheses has a
lower penalty, of error and clearance."""

    def __init__(self, config: StudentTraining) -> None:
        self._config = config
        self.policy = f"student_{config.observation}"
        corpora = [Corpus(Path(path)) for path in config.corpora]
        self._data = StudentData(corpora, config.held_out, config.device, config.worlds)
        camera = self._data.camera
        self.spec = StudentSpec(
            config.observation,
            camera.width,
            camera.height,
            camera.fov_x,
            head_features=config.head_features,
            nominal_speed=self._data.speed,
            way_version=2,
        )
        self.network = StudentModule(self.spec)
        if config.begin:
            self._load(config.begin)
        elif config.pretrained:
            self.network.load_encoder(imagenet_weights(config.encoder))
        self.learns_from = self._data.digest(config.begin)
        self.network.freeze(config.frozen)
        # Convolutions on a CPU take a third less time with the channels last.
        self.network.to(config.device).to(memory_format=torch.channels_last)
        self._views = StudentViews(config, self._data, self.network)
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        self._rank, self._processes = 0, 1
        data, count = self._data.held_out, config.validation_samples
        self._validation = data[np.linspace(0, len(data) - 1, min(count, len(data))).astype(int)]

    def _load(self, weights: str) -> None:
        """Has the network begin with a file of weights: with its encoder, and with all else that
        has the same shape."""
        checkpoint = PolicyCheckpoint.load(weights, self.policy, StudentSpec)
        own = self.network.state_dict()
        fitting = {
            name: torch.from_numpy(values).float()
            for name, values in checkpoint.weights.items()
            if name in own and own[name].shape == values.shape
        }
        missing = own.keys() - fitting.keys()
        if any(name.startswith(("features.", "cell_layer.")) for name in missing):
            raise ValueError(
                f"{weights} has another encoder, {checkpoint.spec} instead of {self.spec}; give "
                "weights of a student with the same"
            )
        self.network.load_state_dict(fitting, strict=False)

    def take_part(self, rank: int, count: int) -> None:
        """See `Trainer`.

        Raises:
            ValueError: unless the batch has `count` equal parts.
        """
        batch = self._config.batch
        if batch % count:
            raise ValueError(
                f"batch is {batch}, of which {count} processes cannot have equal parts; choose a "
                f"multiple of {count}"
            )
        self._rank, self._processes = rank, count

    def begin_update(self, update: int) -> None:
        pass

    def losses(self) -> dict[str, Tensor]:
        numbers = self._data.drawn(self._drawn, self._config.recovery_share)
        mirrored = np.zeros(len(numbers), bool)
        if self._config.mirrored:
            mirrored = self._drawn(2) == 1
        return self._judge(numbers, self._drawn_images(numbers, mirrored), mirrored).terms

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """On held-out worlds, of clean images; see `measures`."""
        batch, rows = self._config.batch, []
        for first in range(0, len(self._validation), batch):
            numbers = self._validation[first : first + batch]
            as_they_are = np.zeros(len(numbers), bool)
            judged = self._judge(numbers, self._views.clean(numbers), as_they_are)
            chosen = judged.costs.argmin(1)
            each = torch.arange(len(chosen))
            clear = (judged.distances[each, chosen] > VEHICLE_RADIUS).all(1)
            error = root_mean_square(judged.errors.amin(1)[each, chosen])
            measures = {
                "success": clear & (error < _CLOSE),
                "clear": clear,
                "error": error,
                "best_chosen": judged.penalties.argmin(1) == chosen,
            }
            rows.append({name: value.float() for name, value in measures.items()})
        return {name: float(torch.cat([row[name] for row in rows]).mean()) for name in rows[0]}

    def state_dict(self) -> dict[str, Any]:
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._generator.set_state(state["generator"])

    def _drawn(self, count: int) -> np.ndarray:
        """A number from 0 to before `count` for each sample of this process's part of a batch."""
        config = self._config
        size, device = (config.batch,), config.device
        drawn = torch.randint(count, size, generator=self._generator, device=device)
        return drawn.cpu().numpy()[self._rank :: self._processes]

    def _drawn_images(self, numbers: np.ndarray, mirrored: np.ndarray) -> Tensor:
        """What the network takes of images to train with, some of them `mirrored` (N,)."""
        config = self._config
        disturbed = np.full(len(numbers), config.disturbed > 0.0)
        if 0.0 < config.disturbed < 1.0:
            disturbed = self._drawn(_LOTS) < config.disturbed * _LOTS
        if config.frozen:
            return self._views.kept(numbers, self._drawn(config.draws), disturbed, mirrored)
        # Of its own: what it draws depends on how many images this process has.
        seed = int(torch.randint(2**62, (1,), generator=self._generator, device=config.device))
        disturbing = torch.Generator(config.device).manual_seed(seed + self._rank)
        return self._views.anew(numbers, disturbed, mirrored, disturbing)

    def _judge(self, numbers: np.ndarray, images: Tensor, mirrored: np.ndarray) -> "_Judged":
        """What the network makes of samples, against their experts and their worlds.

        Where `mirrored` (N,), the image is in a mirror, as is then what the network is told, and
        its waypoints are mirrored back.
        """
        config, labels = self._config, self._data.labels(numbers)
        R_WB = rotation_matrices(labels.X_WB[:, :4])
        state = encode_state(R_WB, labels.v_B, labels.goal_B, self.spec.reach)
        sides = state.new_ones(len(numbers), 3)
        sides[mirrored, 1] = -1.0
        state = (state.unflatten(1, (3, 3)) * sides[:, None]).flatten(1)
        waypoints, costs = self.network(images, state, config.frozen)
        waypoints = waypoints * sides[:, None, None]
        distances = self._data.distance_along(waypoints, labels)
        experts = labels.trajectories_B[:, : config.experts or None]
        errors = hypothesis_errors(experts, waypoints)
        barriers = barrier_along(distances.detach())
        penalties = hypothesis_penalties(errors.detach(), barriers, config.geometric_weight)
        won, unvoted = imitation_terms(errors, config.epsilon, config.handicap)
        votes = winners(errors.detach(), config.handicap).sum((0, 1))
        shares = (votes / votes.sum()).unbind()
        terms = {
            "winners": won,
            "unvoted": unvoted,
            "cost": config.cost_weight * cost_error(costs, cost_targets(penalties)),
            **{f"votes_{m}": share for m, share in enumerate(shares)},
        }
        if config.clearance_weight:
            best = labels.trajectories_B[:, :1]
            kept = self._data.distance_along(best.nan_to_num(), labels)
            kept = torch.where(best.isfinite().all(3), kept, -torch.inf)[:, 0]
            missing = missing_clearances(distances, kept, config.clearance_cap)
            terms["clearance"] = config.clearance_weight * missing.mean()
        return _Judged(terms, costs, errors, distances, penalties)


class _Judged(NamedTuple):
    """N samples, K experts, M hypotheses, T waypoints."""

    terms: dict[str, Tensor]
    """Of the loss; and the parts of the votes that each hypothesis got, which have no gradient."""
    costs: Tensor  # (N, M), predicted
    errors: Tensor  # (N, K, M) [m^2]
    distances: Tensor  # (N, M, T) [m] to the nearest surface
    penalties: Tensor  # (N, M), of equation 4
