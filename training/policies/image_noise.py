"""Noise of images in training, in torch; see `splatpilot.systems.sensing.noise`."""

import math
from dataclasses import fields

import torch
from torch import Tensor

from splatpilot.systems.sensing.noise import ObservationNoise, expose, turned_hue

_OF_DEPTH = "depth_multiplicative", "depth_additive", "depth_dropout"
_OF_TIME = "latency", "frame_rate", "jitter", "frame_dropout"
_OF_COLORS = tuple(
    field.name for field in fields(ObservationNoise) if field.name not in _OF_DEPTH + _OF_TIME
)
"""Fields of `ObservationNoise`."""


def training_noise() -> ObservationNoise:
    """How the images of a training run are disturbed unless its configuration says otherwise."""
    return ObservationNoise(depth_multiplicative=0.03, depth_additive=0.02, depth_dropout=0.01)


def validate_training_noise(
    noise: ObservationNoise, name: str, *, of_depth: bool, of_colors: bool, of_time: bool
) -> None:
    """Checks the noise of a trainer.

    Args:
        noise: to check.
        name: of the field that holds it.
        of_depth, of_colors, of_time: what the trainer's images have noise of; late and lost images
            are of time.

    Raises:
        ValueError: if a value is out of range, or would have no effect.
    """
    noise.validate(name)
    for has, names, images in (
        (of_depth, _OF_DEPTH, "of colors alone"),
        (of_colors, _OF_COLORS, "of depth alone"),
        (of_time, _OF_TIME, "of the moment"),
    ):
        for of in names:
            value = getattr(noise, of)
            if value and not has:
                raise ValueError(
                    f"{name}.{of} must be left out, got {value}: training has images {images}"
                )


def noisy_depth(depth: Tensor, noise: ObservationNoise, generator: torch.Generator) -> Tensor:
    """Planar depth (N, R) [m] as a worse camera of unlimited range measures it, each pixel anew."""
    relative = torch.empty_like(depth).normal_(generator=generator)
    absolute = torch.empty_like(depth).normal_(generator=generator)
    drop = torch.empty_like(depth).uniform_(generator=generator)
    return disturb_depth(depth, noise, relative, absolute, drop)


def disturb_depth(
    depth: Tensor, noise: ObservationNoise, relative: Tensor, absolute: Tensor, drop: Tensor
) -> Tensor:
    """See `splatpilot.systems.sensing.noise`; the range is 0 to infinity."""
    z = depth * (1.0 + noise.depth_multiplicative * relative) + noise.depth_additive * absolute
    measured = depth.isfinite() & (depth > 0.0)
    z = torch.where(measured, z.clamp(min=0.0), depth)
    return torch.where(drop < noise.depth_dropout, torch.inf, z)


def noisy_color(color: Tensor, noise: ObservationNoise, generator: torch.Generator) -> Tensor:
    """Colours (N, H, W, 3), 0 to 255, as a worse camera measures them, each image anew."""
    brighter = torch.empty_like(color[:, 0, 0, 0]).uniform_(-1.0, 1.0, generator=generator)
    grain = torch.empty_like(color).normal_(generator=generator)
    if noise.hue_jitter > 0.0:
        turn = torch.empty_like(brighter).uniform_(-1.0, 1.0, generator=generator)
        turn = math.radians(noise.hue_jitter) * turn[:, None, None, None]
        color = turned_hue(color, turn.cos(), turn.sin())
    if noise.blur > 0.0:
        color = blurred(color, noise.blur)
    if noise.changes_light:
        error = torch.empty_like(brighter).uniform_(-1.0, 1.0, generator=generator)
        photons = torch.empty_like(color).normal_(generator=generator)
        color = expose(color, noise, error[:, None, None, None], photons)
    return disturb_color(color, noise, brighter, grain)


def blurred(color: Tensor, sigma: float) -> Tensor:
    """Colours (N, H, W, 3) through a Gaussian of that standard deviation [px], which ends after
    four of them, as OpenCV's of floats; what lies beyond the image is what it has in a mirror."""
    reach = (round(8 * sigma + 1) | 1) // 2
    x = torch.arange(-reach, reach + 1, dtype=color.dtype, device=color.device)
    weights = torch.exp(-0.5 * (x / sigma) ** 2)
    across = (weights / weights.sum()).expand(3, 1, 1, -1)
    images = torch.nn.functional.pad(color.movedim(-1, 1), [reach] * 4, mode="reflect")
    images = torch.nn.functional.conv2d(images, across, groups=3)
    return torch.nn.functional.conv2d(images, across.mT, groups=3).movedim(1, -1)


def disturb_color(
    color: Tensor, noise: ObservationNoise, brighter: Tensor, grain: Tensor
) -> Tensor:
    """See `splatpilot.systems.sensing.noise`; `brighter` is one number (N,) an image,
    and what is returned is not rounded."""
    gain = 1.0 + noise.brightness_jitter * brighter[:, None, None, None]
    return (gain * color + 255.0 * noise.color_noise * grain).clamp(0.0, 255.0)
