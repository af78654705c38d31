"""Random changes of training images: sensor noise, and the appearance of RGB images.

Each image is changed independently, by the formulas of flights, `systems/sensing/noise.py`.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur

from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.noise import (
    ObservationNoise,
    corrupt_color,
    corrupt_depth,
    expose,
    rotate_hue,
)

_DEPTH = "depth_multiplicative", "depth_additive", "depth_dropout"
_TIME = "latency", "frame_rate", "jitter", "frame_dropout"
_COLOR = tuple(f.name for f in fields(ObservationNoise) if f.name not in _DEPTH + _TIME)
"""Fields of `ObservationNoise`."""


@dataclass
class Appearance(Config):
    """Maximum changes of the appearance of RGB images; uniform, in both directions."""

    # [stops] Exposure; each doubles the brightness.
    exposure: float = bounded(0.5, "[0, 5] stops")
    # [deg] Rotation of the hues.
    hue: float = bounded(15.0, "[0, 180] deg")


def depth_noise() -> ObservationNoise:
    """Returns the default noise of training from depth."""
    return ObservationNoise(depth_multiplicative=0.03, depth_additive=0.02, depth_dropout=0.01)


def color_noise() -> ObservationNoise:
    """Returns the default noise of training from RGB."""
    return ObservationNoise(color_noise=0.02, brightness_jitter=0.2)


def check_noise(
    noise: ObservationNoise, *, depth: bool = False, color: bool = False, time: bool
) -> None:
    """Raises FieldError for noise of depth, color or time (late, lost) that images do not have."""
    for has, names in ((depth, _DEPTH), (color, _COLOR), (time, _TIME)):
        for name in () if has else names:
            require_field(noise, name, not getattr(noise, name), "left out")


def noisy_depth(depth: Tensor, noise: ObservationNoise, generator: torch.Generator) -> Tensor:
    """Adds noise to planar depth (N, ...) [m] of cameras of unlimited range."""
    relative = torch.empty_like(depth).normal_(generator=generator)
    absolute = torch.empty_like(depth).normal_(generator=generator)
    drop = torch.empty_like(depth).uniform_(generator=generator)
    return corrupt_depth(depth, noise, relative, absolute, drop)


def noisy_color(color: Tensor, noise: ObservationNoise, generator: torch.Generator) -> Tensor:
    """Adds noise to colors (N, H, W, 3), 0 to 255."""

    def uniform() -> Tensor:
        return torch.empty_like(color[:, :1, :1, :1]).uniform_(-1.0, 1.0, generator=generator)

    brighter, grain = uniform(), torch.empty_like(color).normal_(generator=generator)
    if noise.hue_jitter > 0.0:
        angle = math.radians(noise.hue_jitter) * uniform()
        color = rotate_hue(color, angle.cos(), angle.sin())
    if noise.blur > 0.0:
        color = blur(color, noise.blur)
    if noise.changes_light:
        error, photons = uniform(), torch.empty_like(color).normal_(generator=generator)
        color = expose(color, noise, error, photons)
    return corrupt_color(color, noise, brighter, grain)


def blur(color: Tensor, sigma: float) -> Tensor:
    """Blurs colors (N, H, W, 3) by a Gaussian [px], as `cv2.GaussianBlur` blurs floats."""
    size = [round(8 * sigma + 1) | 1] * 2
    return gaussian_blur(color.movedim(-1, 1), size, [sigma, sigma]).movedim(1, -1)


def change_appearance(color: Tensor, appearance: Appearance, generator: torch.Generator) -> Tensor:
    """Changes exposure and hue of colors (N, H, W, 3), 0 to 255."""
    draws = torch.rand(2, len(color), 1, 1, 1, generator=generator, device=color.device)
    exposure, hue = 2.0 * draws - 1.0
    color = (2.0 ** (appearance.exposure * exposure) * color).clamp(max=255.0)
    if appearance.hue == 0.0:
        return color
    angle = (appearance.hue * hue).deg2rad()
    return rotate_hue(color, angle.cos(), angle.sin())
