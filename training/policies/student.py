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

from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.student_spec import StudentSpec
from splatpilot.systems.vehicle.flatness_batch import rotation_matrices
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.pretrained import imagenet_weights
from splatpilot.training.policies.student_config import StudentTraining
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_loss import (
    barrier_along,
    cost_error,
    cost_targets,
    hypothesis_errors,
    hypothesis_penalties,
    imitation_terms,
    missing_clearances,
    root_mean_square,
    winners,
)
from splatpilot.training.policies.student_network import StudentModule, encode_state
from splatpilot.training.policies.student_views import StudentViews

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
