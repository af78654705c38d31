"""Imperfections of real cameras: noise, missing depth, changing brightness, delay.

The noise of an image follows from a seed and the image's number alone, so that flights are
deterministic. The formulas take arrays and tensors of floats; training draws its own noise for
them, in `training/policies/augmentation.py`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import cv2
import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import weak_callback
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import array_namespace

_GAMMA = 2.2  # of colors over light


def light_of_color(color: Any) -> Any:
    """Returns the light (...), 0 to 1, of colors, 0 to 255."""
    return (color / 255.0) ** _GAMMA


def color_of_light(light: Any) -> Any:
    """Returns the colors (...), 0 to 255, of light, clipped to 0 to 1."""
    return 255.0 * light.clip(0.0, 1.0) ** (1.0 / _GAMMA)


@dataclass
class ObservationNoise(Config):
    """Sizes of noise, none by default; standard deviations of Gaussians if not stated otherwise."""

    # [-] Error of each depth pixel relative to its depth.
    depth_multiplicative: float = bounded(0.0, "[0, 1]")
    # [m] Error of each depth pixel that does not grow with depth.
    depth_additive: float = bounded(0.0, "[0, inf) m")
    # [-] Probability of each depth pixel to read infinity, as the Starling's time-of-flight
    # streamer does without an echo.
    depth_dropout: float = bounded(0.0, "[0, 1]")
    # [-] Noise of each color pixel and channel, as a fraction of full scale.
    color_noise: float = bounded(0.0, "[0, 1]")
    # [-] Maximum change in brightness of a whole image; uniform up to it, up and down.
    brightness_jitter: float = bounded(0.0, "[0, 1]")
    # [deg] Maximum rotation of an image's colors about gray; uniform up to it, in both directions.
    hue_jitter: float = bounded(0.0, "[0, 180] deg")
    # [px] Blur of color images, as of a lens out of focus.
    blur: float = bounded(0.0, "[0, 50] px")
    # [EV] Maximum error of an image's exposure, in factors of two of light; uniform up to it, up
    # and down. Values above white are clipped.
    exposure_error: float = bounded(0.0, "[0, 6] EV")
    # [electrons] Of a color pixel at white, whose number varies by its root, as photons do. 0 is
    # without shot noise; phones and small machine vision have 5,000 to 10,000.
    full_well: float = bounded(0.0, "[0, inf) electrons")
    # [electrons] Noise of reading out a color pixel; 2 to 10 are usual.
    read_noise: float = bounded(0.0, "[0, inf) electrons")
    # [s] Age of images on arrival; the policy's state is up to date.
    latency: float = bounded(0.0, "[0, 1] s")
    # [Hz] Range from which a flight's rate of images is drawn; if empty, an image is taken at each
    # update of the policy. The following fields need a rate, see `latency.py`.
    frame_rate: list[float] = bounded(list, "[0.1, 1000] Hz")
    # [s] Maximum additional latency; uniform up to it.
    jitter: float = bounded(0.0, "[0, 1] s")
    # [-] Probability that an image is lost.
    frame_dropout: float = bounded(0.0, "[0, 1]")

    def check(self) -> None:
        well = self.read_noise == 0.0 or self.full_well > 0.0
        require_field(self, "read_noise", well, "0 without full_well")
        rates = self.frame_rate
        valid = not rates or (len(rates) == 2 and rates[0] <= rates[1])
        require_field(self, "frame_rate", valid, "two numbers in ascending order, or empty")
        for name in ("jitter", "frame_dropout"):
            valid = bool(rates) or getattr(self, name) == 0.0
            require_field(self, name, valid, "0 without frame_rate")

    @property
    def changes_depth(self) -> bool:
        """True if depth images change."""
        return max(self.depth_multiplicative, self.depth_additive, self.depth_dropout) > 0.0

    @property
    def is_late(self) -> bool:
        """True if the policy sees delayed images."""
        return self.latency > 0.0 or bool(self.frame_rate)

    @property
    def changes_color(self) -> bool:
        """True if color images change."""
        changes = self.color_noise, self.brightness_jitter, self.hue_jitter, self.blur
        return max(changes) > 0.0 or self.changes_light

    @property
    def changes_light(self) -> bool:
        """True if the exposure of color images changes."""
        return max(self.exposure_error, self.full_well) > 0.0


def corrupt_depth(
    depth: Any,
    noise: ObservationNoise,
    relative: Any,
    absolute: Any,
    drop: Any,
    min_depth: float = 0.0,
    max_depth: float = math.inf,
) -> Any:
    """Adds errors and holes to planar depth [m]: `relative` n_1 and `absolute` n_2 are drawn from
    N(0, 1), `drop` u from U(0, 1), each of the depth's shape.

        z' = z (1 + depth_multiplicative n_1) + depth_additive n_2

    Pixels of 0 or infinity keep that. Beyond the range of the camera the result is as of Drake's
    cameras: 0 below `min_depth`, infinity above `max_depth` [m]. It is infinity if
    u < depth_dropout.
    """
    xp = array_namespace(depth)
    measured = xp.isfinite(depth) & (depth > 0.0)
    z = xp.where(measured, depth, 1.0)
    z = z * (1.0 + noise.depth_multiplicative * relative) + noise.depth_additive * absolute
    z = xp.where(measured, limit_depth(z, min_depth, max_depth), depth)
    return xp.where(drop < noise.depth_dropout, math.inf, z)


def limit_depth(depth: Any, min_depth: float, max_depth: float) -> Any:
    """Reads 0 below the minimum depth [m] of a camera and infinity above its maximum, as Drake."""
    xp = array_namespace(depth)
    return xp.where(depth < min_depth, 0.0, xp.where(depth > max_depth, math.inf, depth))


def rotate_hue(color: Any, cos: Any, sin: Any) -> Any:
    """Rotates colors (..., 3), 0 to 255, about gray by an angle, red toward green toward blue.

    Rodrigues' formula with the axis k = (1, 1, 1) / sqrt(3).

        c' = clip(cos c + (1 - cos) (k · c) k + sin k x c)
    """
    gray = color.sum(-1)[..., None] / 3.0
    across = (color[..., [2, 0, 1]] - color[..., [1, 2, 0]]) / math.sqrt(3.0)
    return (cos * color + (1.0 - cos) * gray + sin * across).clip(0.0, 255.0)


def expose(color: Any, noise: ObservationNoise, error: Any, photons: Any) -> Any:
    """Exposes colors (..., 3), 0 to 255, with shot and read noise; `error` u is drawn from U(-1, 1)
    for each image, `photons` n from N(0, 1), of the colors' shape.

        light' = 2^(exposure_error u) (c / 255)^2.2
        c' = 255 clip(light' + n sqrt(light' / full_well + (read_noise / full_well)^2))^(1 / 2.2)
    """
    light = light_of_color(color) * 2.0 ** (noise.exposure_error * error)
    if noise.full_well > 0.0:
        variance = light / noise.full_well + (noise.read_noise / noise.full_well) ** 2
        light = light + photons * variance**0.5
    return color_of_light(light)


def corrupt_color(color: Any, noise: ObservationNoise, brighter: Any, grain: Any) -> Any:
    """Changes the brightness of colors (..., 3), 0 to 255, and adds noise.

    `brighter` u is drawn from U(-1, 1) for each image, and `grain` n (..., 3) from N(0, 1).

        c' = clip(c (1 + brightness_jitter u) + 255 color_noise n)
    """
    gain = 1.0 + noise.brightness_jitter * brighter
    return (gain * color + 255.0 * noise.color_noise * grain).clip(0.0, 255.0)


class ImageChange(LeafSystem):
    """Base of systems that change images of a `camera`, by a `config`.

    Stateless: the noise follows from the seed and the image's number, `frame_number` of a time [s]
    or, if that is None, the time in units of 1 / `rate` [Hz], so that evaluations of one image
    agree. Types differ in their `stream`.
    """

    port: ClassVar[str]
    image: ClassVar[type]
    stream: ClassVar[tuple[int, ...]] = ()

    def __init__(
        self,
        config: Config,
        camera: OnboardCamera,
        rate: float,
        seed: int,
        frame_number: Callable[[float], int | None] = lambda time: None,
    ) -> None:
        super().__init__()
        config.validate()
        self.config: Any = config
        self._frame_number = frame_number
        self.camera, self._rate, self._seed = camera, rate, seed
        blank = self.image(camera.width, camera.height)
        self.DeclareAbstractInputPort(self.port, Value(blank))
        self.DeclareAbstractOutputPort(self.port, lambda: Value(blank), weak_callback(self._calc))

    def _calc(self, context: Context, output: AbstractValue) -> None:
        image = np.asarray(cast(Any, self.get_input_port().Eval(context)).data)
        time = context.get_time()
        if (number := self._frame_number(time)) is None:
            number = math.floor(time * self._rate + 1e-6)
        random = np.random.default_rng([self._seed, number, *self.stream])
        pixels = cast(Any, output.get_mutable_value()).mutable_data
        pixels[:] = self.changed(image, random)

    def changed(self, image: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Returns the changed image (H, W, C)."""
        raise NotImplementedError


class DepthNoise(ImageChange):
    """Adds errors and holes to ``depth_image_32f`` of planar depth [m], see `corrupt_depth`."""

    port, image = "depth_image_32f", ImageDepth32F

    def changed(self, image: np.ndarray, random: np.random.Generator) -> np.ndarray:
        relative, absolute = random.standard_normal((2, *image.shape))
        drop, limits = random.random(image.shape), (self.camera.min_depth, self.camera.max_depth)
        return corrupt_depth(image, self.config, relative, absolute, drop, *limits)


class ColorNoise(ImageChange):
    """Changes hue, blur, exposure and brightness of ``color_image``, and adds noise to each pixel;
    see `rotate_hue`, `expose` and `corrupt_color`. Alpha is kept."""

    port, image = "color_image", ImageRgba8U

    def changed(self, image: np.ndarray, random: np.random.Generator) -> np.ndarray:
        noise, color = self.config, image[..., :3].astype(np.float32)
        brighter = random.uniform(-1.0, 1.0)
        grain = np.float32(0.0)
        if noise.color_noise > 0.0:
            grain = random.standard_normal(color.shape, dtype=np.float32)
        if noise.hue_jitter > 0.0:
            angle = math.radians(noise.hue_jitter * random.uniform(-1.0, 1.0))
            color = rotate_hue(color, math.cos(angle), math.sin(angle))
        if noise.blur > 0.0:
            color = cv2.GaussianBlur(color, (0, 0), noise.blur)
        if noise.changes_light:
            error = np.float32(random.uniform(-1.0, 1.0))
            photons = random.standard_normal(color.shape, dtype=np.float32)
            color = expose(color, noise, error, photons)
        color = corrupt_color(color, noise, brighter, grain) + np.float32(0.5)
        return np.dstack([color.astype(np.uint8), image[..., 3]])
