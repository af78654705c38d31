"""What the student's network takes of samples: images, or what frozen modules make of them."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.sensing.observation_noise import ObservationNoise
from splatpilot.training.policies.student_config import StudentTraining
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_features import FrozenFeatures
from splatpilot.training.policies.student_images import (
    Appearance,
    clean_images,
    in_a_mirror,
    training_images,
)
from splatpilot.training.policies.student_network import StudentModule


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
