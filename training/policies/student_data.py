"""What the student learns from: samples of several corpora, and the distances in their worlds."""

from collections.abc import Callable, Sequence
from functools import cached_property
from hashlib import blake2b
from itertools import chain
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.diagrams.worlds.scene_folder import SceneSource
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.vehicle.state import rotation_matrices
from splatpilot.training.corpus.corpus import Corpus, distinct_shards, distinct_worlds
from splatpilot.training.corpus.library import require_untested
from splatpilot.training.corpus.samples import RECOVERY
from splatpilot.training.policies.ray_casting import EsdfGeometry

_PARTS = 1 << 20
"""[-] That a chance is counted in."""

_DIGESTS = 1 << 64
"""Number of digests that a name may have."""


class Labels(NamedTuple):
    """Of N samples, float32 in the body frame B; see `Samples`."""

    X_WB: Tensor  # (N, 7) quaternion wxyz and position [m]
    v_B: Tensor  # (N, 3) [m/s]
    goal_B: Tensor  # (N, 3) [m]
    trajectories_B: Tensor  # (N, K, 10, 3) [m]
    world: Tensor  # (N,) int64, index into `StudentData.worlds`


class StudentData:
    """Corpora as one, their worlds known by name, some of them held out.

    Args:
        corpora: may share worlds, and shards, which count once.
        held_out: part of the worlds whose samples are not trained with, see `is_held_out`.
        device: where labels live; images stay on disk.
        worlds: how many of the others are trained in, all if 0. More of them are the same and more.

    Raises:
        ValueError: if the corpora's samples differ in kind, two of their worlds have one name and
            differ, or too few worlds are left to train in.
    """

    def __init__(
        self, corpora: Sequence[Corpus], held_out: float, device: str = "cpu", worlds: int = 0
    ) -> None:
        configs = [corpus.config for corpus in corpora]
        self.camera, self.speed = configs[0].camera, configs[0].expert.speed
        """What the samples were seen through; the expert's nominal speed [m/s]."""
        for config in configs:
            if (config.camera, config.size) != (self.camera, configs[0].size):
                raise ValueError(
                    f"the corpora were gathered with different cameras or numbers of trajectories, "
                    f"{configs[0].size} by {self.camera} and {config.size} by {config.camera}; "
                    "gather them alike"
                )
            if config.expert.speed != self.speed:
                raise ValueError(
                    f"the corpora's experts flew at {self.speed} and {config.expert.speed} m/s; a "
                    "student has one nominal speed: gather them at the same"
                )
        records = distinct_worlds(corpora)
        for record in records.values():
            if isinstance(record.source.world, SceneSource):
                require_untested(record.source.source_digest, str(record.path))
        self.held_out_worlds = sorted(name for name in records if is_held_out(name, held_out))
        others = sorted(records.keys() - set(self.held_out_worlds), key=_digest)
        if worlds > len(others):
            raise ValueError(
                f"worlds is {worlds}, but of the corpora's {len(records)} worlds {len(others)} are "
                "left to train in; gather in more worlds, or say fewer"
            )
        self.worlds = sorted([*self.held_out_worlds, *others[: worlds or None]])
        """Names."""
        chosen = set(self.worlds)
        shards = chain.from_iterable(distinct_shards(corpora))
        self.shards = [shard for shard in shards if len(shard) and shard.world in chosen]
        """Blocks of samples, which are numbered through them."""
        counts = [len(shard) for shard in self.shards]
        self.first = np.cumsum([0, *counts])
        """The number of each shard's first sample."""
        number = {name: k for k, name in enumerate(self.worlds)}
        world = np.repeat([number[shard.world] for shard in self.shards], counts)
        outside = np.isin(world, [number[name] for name in self.held_out_worlds])
        self.training, self.held_out = np.flatnonzero(~outside), np.flatnonzero(outside)
        """Numbers of samples."""
        recovered = np.repeat([shard.source == RECOVERY for shard in self.shards], counts)
        self.recovered = np.flatnonzero(~outside & recovered)
        """Numbers of those to train with that a student came to."""
        self._shown = np.flatnonzero(~outside & ~recovered)
        if not (len(self.training) and len(self.held_out)):
            least = ceil(100 * min(map(_digest, records)) / _DIGESTS) / 100
            raise ValueError(
                f"of {len(self.worlds)} worlds {len(self.held_out_worlds)} are held out, which "
                f"leaves {len(self.training)} samples to train with and {len(self.held_out)} to "
                "validate with; collect in more worlds, or change held_out: from "
                f"{least} on it holds out one of these"
            )

        def joined(name: str) -> Tensor:
            arrays = [shard.arrays[name] for shard in self.shards]
            return torch.from_numpy(np.concatenate(arrays)).float().to(device)

        self._labels = Labels(
            X_WB=joined("X_WB"),
            v_B=joined("v_B"),
            goal_B=joined("goal_B"),
            trajectories_B=joined("trajectories_B"),
            world=torch.from_numpy(world).to(device),
        )
        self._records = records

    def digest(self, *files: str) -> str:
        """What tells these samples, and the content of the `files` that are named, from others."""
        what = blake2b(digest_size=16)
        for shard in self.shards:  # each states the checksums of all that it has
            what.update(shard.path.name.encode() + (shard.path / "shard.json").read_bytes())
        what.update(" ".join(self.held_out_worlds).encode())
        for file in filter(None, files):
            what.update(Path(file).read_bytes())
        return what.hexdigest()

    def drawn(self, draw: Callable[[int], np.ndarray], recovery_share: float = 0.0) -> np.ndarray:
        """Numbers (N,) of samples to train with.

        Args:
            draw: gives N whole numbers, each from 0 to before a count, whichever is as likely.
            recovery_share: chance of each to be of recovery; where it is 0, or none is, all samples
                are as likely.
        """
        if not (recovery_share and len(self.recovered)):
            return self.training[draw(len(self.training))]
        met, shown = (group[draw(len(group))] for group in (self.recovered, self._shown))
        return np.where(draw(_PARTS) < recovery_share * _PARTS, met, shown)

    def labels(self, numbers: np.ndarray) -> "Labels":
        """What belongs to the images of the samples of `numbers` (N,)."""
        chosen = torch.from_numpy(numbers).to(self._labels.world.device)
        return Labels(*(values[chosen] for values in self._labels))

    def pixels(self, numbers: np.ndarray, name: str) -> np.ndarray:
        """The images `color` or `depth` of the samples of `numbers` (N,), see `Samples`."""
        arrays = [shard.arrays[name] for shard in self.shards]
        found = np.empty((len(numbers), *arrays[0].shape[1:]), arrays[0].dtype)
        for row, (k, within) in enumerate(zip(*self.places(numbers), strict=True)):
            found[row] = arrays[k][within]
        return found

    def places(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """In which shards, and where in these, the samples of `numbers` (N,) are."""
        shard = np.searchsorted(self.first, numbers, side="right") - 1
        return shard, numbers - self.first[shard]

    def distance_along(self, waypoints_B: Tensor, labels: Labels) -> Tensor:
        """Signed distance (N, M, T) [m] at waypoints (N, M, T, 3) [m] from samples' poses,
        differentiable by the waypoints."""
        N, M, T, _ = waypoints_B.shape
        R_WB, p_WB = rotation_matrices(labels.X_WB[:, :4]), labels.X_WB[:, None, 4:]
        p_WQ = (waypoints_B.flatten(1, 2) @ R_WB.mT + p_WB).flatten(0, 1)
        world = labels.world.repeat_interleave(M * T)
        distances, gradients = self._fields.interpolate(p_WQ.detach(), world)
        along = (gradients * (p_WQ - p_WQ.detach())).sum(1)
        return (distances + along).reshape(N, M, T)

    @cached_property
    def _fields(self) -> EsdfGeometry:
        """The distances in all worlds, which not everybody asks for."""
        return EsdfGeometry([_trusted(self._records[name].esdf()) for name in self.worlds])


def is_held_out(name: str, share: float) -> bool:
    """Tells whether a world validates; about `share` of all worlds do.

    Its name alone decides, so that it stays on its side when a corpus grows or another is added,
    and those of a smaller share are among those of a larger one.
    """
    return _digest(name) < share * _DIGESTS


def _digest(name: str) -> int:
    """Returns a number below `_DIGESTS` that depends on nothing but the name."""
    return int.from_bytes(blake2b(name.encode()).digest()[:8])


def _trusted(esdf: Esdf) -> Esdf:
    """Unknown space counts as occupied, as for the expert."""
    return esdf if esdf.occupied_outside else esdf.conservative()
