"""Images for the student: encoded, and in training never twice the same."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.sensing.noise import ObservationNoise, turned_hue
from splatpilot.training.policies.image_noise import noisy_color, noisy_depth
from splatpilot.training.policies.student_network import encode_color, encode_depth


@dataclass
class Appearance:
    """How far the looks of a place are changed; uniform up to each, up and down, for each image."""

    # [stops] Exposure: twice as bright for each.
    exposure: float = 0.5
    # [deg] By which colours are turned about grey.
    hue: float = 15.0

    def validate(self, name: str) -> None:
        """Raises ValueError on a value out of range, naming it as a field of `name`."""
        for field, limit in (("exposure", 5.0), ("hue", 180.0)):
            value = getattr(self, field)
            if not 0.0 <= value <= limit:
                raise ValueError(f"{name}.{field} is {value}; it must be 0 to {limit:g}")


def in_a_mirror(pixels: np.ndarray) -> np.ndarray:
    """Images (N, H, W, ...) with left and right exchanged."""
    seen = np.empty_like(pixels)
    for image, out in zip(pixels, seen, strict=True):  # 20 times as fast as NumPy's of colours
        cv2.flip(image, 1, out)
    return seen


def clean_images(pixels: np.ndarray, device: str = "cpu") -> Tensor:
    """Images (N, 3, H, W) as the network takes them, of colours (N, H, W, 3) or depth (N, H, W)
    [m]."""
    images = torch.from_numpy(pixels).to(device).float()
    return encode_color(images) if images.ndim == 4 else encode_depth(images)


def training_images(
    pixels: np.ndarray,
    appearance: Appearance,
    noise: ObservationNoise,
    generator: torch.Generator,
) -> Tensor:
    """The same in another light and through a worse camera, drawn anew each time."""
    images = torch.from_numpy(pixels).to(generator.device).float()
    # Nothing is drawn that changes nothing: that takes a third as long as seven modules.
    noisy = noise != ObservationNoise()
    if images.ndim == 3:
        return encode_depth(noisy_depth(images, noise, generator) if noisy else images)
    if appearance != Appearance(0.0, 0.0):
        draws = torch.rand(2, len(images), generator=generator, device=images.device) * 2.0 - 1.0
        images = relit(images, 2.0 ** (appearance.exposure * draws[0]), appearance.hue * draws[1])
    return encode_color(
        noisy_color(images, noise, generator) if noisy else images.clamp(0.0, 255.0)
    )


def relit(color: Tensor, gain: Tensor, hue: Tensor) -> Tensor:
    """Colours (N, H, W, 3), 0 to 255, times `gain` (N,), turned by `hue` (N,) [deg], see
    `turned_hue`."""
    turn = hue.deg2rad()[:, None, None, None]
    return turned_hue(gain[:, None, None, None] * color, turn.cos(), turn.sin())
