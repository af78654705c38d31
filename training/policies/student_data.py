"""Samples of corpora for training: labels, images, distances in their worlds, cached features."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from hashlib import blake2b
from itertools import chain
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot.diagrams.worlds.scene_folder import SceneSource
from splatpilot.systems.common.files import require_writable_folder, written_atomically
from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.student import encode_color, encode_depth
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
from splatpilot.training.policies.networks import StudentModule
from splatpilot.training.policies.ray_casting import EsdfGeometry
from splatpilot.training.policies.trainer import Trainer

_CHANCES = 1 << 20  # resolution of random choices
_DIGESTS = 1 << 64  # number of possible digests of a name
_BATCH = 8  # Images encoded at once, whose activations fit a processor's caches.


class Labels(NamedTuple):
    """Labels of N samples, float32, in the body frame B; see `Samples`."""

    X_WB: Tensor  # (N, 7) quaternion wxyz and position [m]
    v_B: Tensor  # (N, 3) [m/s]
    goal_B: Tensor  # (N, 3) [m]
    trajectories_B: Tensor  # (N, K, 10, 3) [m]
    world: Tensor  # (N,) int64, index into `StudentData.worlds`


class StudentData:
    """The distinct samples of several corpora. A fraction of their worlds is held out, see
    `held_out_worlds`. Labels are on a device; images stay on disk."""

    def __init__(self, corpora: Sequence[Corpus], held_out: float, device: str = "cpu") -> None:
        configs = [corpus.config for corpus in corpora]
        self.camera, self.speed = configs[0].camera, configs[0].expert.speed
        for what, values in (
            ("cameras", [config.camera for config in configs]),
            ("numbers of trajectories", [config.size.trajectories for config in configs]),
            ("speeds of the expert", [config.expert.speed for config in configs]),
        ):
            if other := [value for value in values if value != values[0]]:
                raise ValueError(
                    f"{what} of the corpora must be equal, got {values[0]} and {other[0]}; collect "
                    "them with the same"
                )
        self._records = distinct_worlds(corpora)
        for corpus in corpora:
            valid, found = not corpus.config.worlds.held_out, "one of worlds.held_out"
            require(valid, f"{corpus.folder}", "a corpus to train with", found, "collect another")
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
            numbers = map(_digest, _environments(self._records).values())
            smallest = ceil(100 * min(numbers) / _DIGESTS) / 100
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
        """Draws indices (count,) of training samples, those of recovery with the probability
        `recovery_share`; if it is 0, all samples are as likely."""

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
        """Computes signed distances (N, M, T) [m] at waypoints (N, M, T, 3) [m], differentiable by
        the waypoints."""
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
    """Returns the names, in order, of the `fraction` of all worlds that validate. Only the name of
    a world counts, or the source of its scene if there are others, so that it stays on its side
    when corpora grow. The worlds of a smaller fraction are among those of a larger one."""
    environments = _environments(records)
    return [name for name in sorted(records) if is_held_out(environments[name], fraction)]


def _environments(records: Mapping[str, WorldRecord]) -> dict[str, str]:
    """Returns the source of the scene of each world, or else its name."""
    sources = {name: "".join(record.source.source_digest) for name, record in records.items()}
    if len(set(sources.values())) == 1:
        return {name: name for name in records}
    return {name: source or name for name, source in sources.items()}


def is_held_out(name: str, fraction: float) -> bool:
    """Tells whether an environment is among the `fraction` of all that validate."""
    return _digest(name) < fraction * _DIGESTS


def _digest(name: str) -> int:
    """Computes a number in [0, `_DIGESTS`) from a name."""
    return int.from_bytes(blake2b(name.encode()).digest()[:8])


def encode_images(pixels: np.ndarray, device: str | torch.device = "cpu") -> Tensor:
    """Encodes images (N, H, W, 3) or planar depth (N, H, W) [m] for the network, (N, 3, H, W)."""
    images = torch.from_numpy(pixels).to(device).float()
    return encode_color(images) if images.ndim == 4 else encode_depth(images)


class FrozenFeatures:
    """Outputs of the network's first modules for all samples, computed once and kept in files. The
    file of a shard is named by a digest of its images and the modules' weights, so that runs share
    files and corpora may grow. `frozen` is the number of modules, of `IMAGE_MODULES`."""

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
                images = encode_images(np.array(pixels[first : first + _BATCH]), device)
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
