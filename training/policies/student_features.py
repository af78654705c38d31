"""What frozen modules of the encoder make of images: computed once, and kept in files."""

from collections.abc import Iterable, Iterator
from hashlib import blake2b
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.common.files import require_writable_folder, written_atomically
from splatpilot.systems.common.progress import Progress, say
from splatpilot.systems.common.readers import reason_of
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.corpus.samples import Shard
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_images import (
    Appearance,
    clean_images,
    in_a_mirror,
    training_images,
)
from splatpilot.training.policies.student_network import StudentModule

_BATCH = 8
"""More than a processor keeps in its caches takes longer: 32 images 2.7 times as long each."""
_FIRST = 7
"""Modules that take most of the time, and are the same for many encoders: what they make is kept
too."""


class FrozenFeatures:
    """Features of all samples: of the images as they are in worlds that are held out, in the others
    of several draws of light and noise.

    A file for each shard is named by everything that it depends on: runs share what they have in
    common, a corpus that grew costs what is new, and a run that was interrupted goes on.

    Args:
        folder: of the files.
        data: the samples.
        network: whose encoder it is.
        frozen: how many of its first modules, of `IMAGE_MODULES`.
        draws: of each image that is trained with.
        appearance, noise: what is drawn.
        mirrored: whether the images are seen in a mirror.

    Raises:
        OSError: if `folder` cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        data: StudentData,
        network: StudentModule,
        frozen: int,
        draws: int,
        appearance: Appearance,
        noise: ObservationNoise,
        mirrored: bool = False,
    ) -> None:
        require_writable_folder(folder)
        self._data, self.draws = data, draws
        below = None
        if frozen > _FIRST:
            below = FrozenFeatures(
                folder, data, network, _FIRST, draws, appearance, noise, mirrored
            )
        self._network, self._frozen = network, frozen
        self._pixels = network.spec.pixels
        self._appearance, self._noise, self._mirrored = appearance, noise, mirrored
        settings = repr((network.spec.observation, draws, appearance, noise)).encode()
        settings += b"mirrored" * mirrored
        modules = network.image_modules(frozen)
        weights = [values.detach().cpu().numpy() for values in modules.parameters()]
        what = blake2b(b"".join([settings, *(values.tobytes() for values in weights)]))
        self._files: list[np.ndarray] = []
        for number, shard in enumerate(
            Progress(
                data.shards,
                desc=f"encoding {'flipped ' * mirrored}images by {frozen} frozen modules",
                unit="shard",
            )
        ):
            outside = shard.world in data.held_out_worlds
            digest = what.copy()
            # It states the checksums of the images.
            digest.update((shard.path / "shard.json").read_bytes() + bytes([outside]))
            file = folder / f"{digest.hexdigest()[:32]}.npy"
            opened = _opened(file)
            if opened is None:
                seed = int.from_bytes(digest.digest()[:7])
                if below is None:
                    batches = self._images(shard, 0 if outside else draws, seed)
                else:
                    batches = _in_batches(below._files[number])
                features = self._features(batches, _FIRST if below else 0)
                with written_atomically(file) as path:
                    np.save(path, features.reshape(-1, len(shard), *features.shape[1:]))
                opened = np.load(file, mmap_mode="r")
            self._files.append(opened)

    def __call__(self, numbers: np.ndarray, draw: np.ndarray) -> Tensor:
        """Features (N, ...) of the samples of `numbers` (N,), of the draws `draw` (N,); samples
        of held-out worlds have the draw 0 alone."""
        rows = zip(*self._data.places(numbers), draw, strict=True)
        return torch.from_numpy(np.stack([self._files[k][d, n] for k, n, d in rows])).float()

    @torch.no_grad()
    def _features(self, batches: Iterable[Tensor], first: int) -> np.ndarray:
        """(draws n, ...) float16 of what the modules before `first` made of n images."""
        device = next(self._network.parameters()).device
        kept = []
        for batch in batches:
            encoded = self._network.encode_image(batch.float().to(device), first, self._frozen)
            kept.append(encoded.half().cpu().numpy())
        return np.concatenate(kept)

    def _images(self, shard: Shard, draws: int, seed: int) -> Iterator[Tensor]:
        """The images of a shard as often as is asked, each time anew; as they are where 0."""
        device = next(self._network.parameters()).device
        generator = torch.Generator(device).manual_seed(seed)
        pixels = shard.arrays[self._pixels]
        for _ in range(max(draws, 1)):
            for first in range(0, len(pixels), _BATCH):
                batch = np.array(pixels[first : first + _BATCH])
                if self._mirrored:
                    batch = in_a_mirror(batch)
                if draws:
                    yield training_images(batch, self._appearance, self._noise, generator)
                else:
                    yield clean_images(batch, str(device))


def _opened(file: Path) -> np.ndarray | None:
    """A file's features, mapped; None where it is not there. One that is damaged goes, to be made
    anew."""
    try:
        return np.load(file, mmap_mode="r")
    except FileNotFoundError:
        return None
    except (ValueError, EOFError) as error:
        say(f"{file} is damaged ({reason_of(error)}): it is made anew")
        file.unlink()
        return None


def _in_batches(features: np.ndarray) -> Iterator[Tensor]:
    """Features (draws, n, ...) in the order of `FrozenFeatures._images`."""
    for draw in features:
        for first in range(0, len(draw), _BATCH):
            yield torch.from_numpy(np.array(draw[first : first + _BATCH]))
