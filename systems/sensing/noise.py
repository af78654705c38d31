"""What real cameras add to images: noise, missing depth, changing brightness, delay.

The noise of an image is a function of a seed and of the image's number alone. It can be drawn again
for any image, in any order, and a flight with it repeats bit for bit. Policies train with the same
noise; training repeats the formulas in torch (`training/policies/torch_observations.py`).
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any, cast

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import input_port, output_port, weakly
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

_LARGEST_LATENCY = 1.0  # [s]
_LARGEST_EXPOSURE_ERROR = 6.0  # [EV]
_LARGEST_BLUR = 50.0  # [px]
_GAMMA = 2.2  # of colours over light


@dataclass
class ObservationNoise:
    """How much of each there is; none by default. The noise is Gaussian, its sizes are standard
    deviations."""

    # [-] Error of each depth pixel relative to its depth.
    depth_multiplicative: float = 0.0
    # [m] Error of each depth pixel that does not grow with depth.
    depth_additive: float = 0.0
    # [-] Probability of each depth pixel to read nothing, which is infinity, as if nothing were
    # within range: so the Starling's time-of-flight streamer gives a pixel without an echo.
    depth_dropout: float = 0.0
    # [-] Noise of each colour pixel and channel, in parts of full scale.
    color_noise: float = 0.0
    # [-] Largest change in brightness of a whole image; uniform up to it, up and down.
    brightness_jitter: float = 0.0
    # [deg] Largest turn of an image's colours about grey; uniform up to it, both ways.
    hue_jitter: float = 0.0
    # [px] Blur of colour images, as of a lens out of focus: the standard deviation of a Gaussian.
    blur: float = 0.0
    # [EV] Largest error of an image's exposure: light doubles with each; uniform up to it, up and
    # down. What becomes brighter than white is lost.
    exposure_error: float = 0.0
    # [electrons] That fill a colour pixel at white, whose number varies as photons do: by its root.
    # 0 counts without noise; phones and small machine vision have 5,000 to 10,000.
    full_well: float = 0.0
    # [electrons] Noise of reading a colour pixel out; 2 to 10 are usual.
    read_noise: float = 0.0
    # [s] How old images are when they come; the policy's state is up to date.
    latency: float = 0.0
    # [Hz] Range that a flight's rate of images is drawn from; where left out, an image is taken
    # whenever the policy looks. What follows is of images with a rate, see `frame_times.py`.
    frame_rate: list[float] = field(default_factory=list)
    # [s] How much later than the latency an image may come; uniform up to it.
    jitter: float = 0.0
    # [-] Probability of an image never to come.
    frame_dropout: float = 0.0

    def validate(self, name: str = "observation") -> None:
        """Raises ValueError on a value out of range, naming it as a field of `name`, its limit and
        the remedy."""
        limits = {
            "depth_additive": math.inf,
            "hue_jitter": 180.0,
            "blur": _LARGEST_BLUR,
            "exposure_error": _LARGEST_EXPOSURE_ERROR,
            "full_well": math.inf,
            "read_noise": math.inf,
            "latency": _LARGEST_LATENCY,
            "jitter": _LARGEST_LATENCY,
        }
        for number in fields(self):
            if number.name == "frame_rate":
                continue
            value, limit = getattr(self, number.name), limits.get(number.name, 1.0)
            if not (0.0 <= value <= limit and value < math.inf):
                most = f" and at most {limit:g}" if limit < math.inf else " and finite"
                raise ValueError(f"{name}.{number.name} is {value}; it must be at least 0{most}")
        if self.read_noise > 0.0 and self.full_well == 0.0:
            raise ValueError(
                f"{name}.read_noise is {self.read_noise} electrons, but how many make white is not "
                f"said; give {name}.full_well too, as 8000"
            )
        rates = self.frame_rate
        if rates and not (len(rates) == 2 and 0.1 <= rates[0] <= rates[1] <= 1000.0):
            raise ValueError(
                f"{name}.frame_rate is {rates}; it must be two numbers of 0.1 to 1000 Hz, the "
                "lesser first, or nothing"
            )
        for of_frames in ("jitter", "frame_dropout"):
            if not rates and getattr(self, of_frames) > 0.0:
                raise ValueError(
                    f"{name}.{of_frames} is {getattr(self, of_frames)}, but images without a rate "
                    f"have none; give {name}.frame_rate too, as [10, 30]"
                )

    @property
    def changes_depth(self) -> bool:
        """Whether depth images are touched."""
        return max(self.depth_multiplicative, self.depth_additive, self.depth_dropout) > 0.0

    @property
    def is_late(self) -> bool:
        """Whether the policy sees other images than those of the moment."""
        return self.latency > 0.0 or bool(self.frame_rate)

    @property
    def changes_color(self) -> bool:
        """Whether colour images are touched."""
        changes = self.color_noise, self.brightness_jitter, self.hue_jitter, self.blur
        return max(changes) > 0.0 or self.changes_light

    @property
    def changes_light(self) -> bool:
        """Whether colour images are exposed anew."""
        return max(self.exposure_error, self.full_well) > 0.0


def noisy_depth(
    depth: np.ndarray,
    noise: ObservationNoise,
    generator: np.random.Generator,
    min_depth: float,
    max_depth: float,
) -> np.ndarray:
    """The depth image (H, W) float32 [m] with errors and holes; see `disturb_depth`."""
    relative, absolute = generator.standard_normal((2, *depth.shape))
    drop = generator.random(depth.shape)
    return disturb_depth(depth, noise, relative, absolute, drop, min_depth, max_depth)


def disturb_depth(
    depth: np.ndarray,
    noise: ObservationNoise,
    relative: np.ndarray,
    absolute: np.ndarray,
    drop: np.ndarray,
    min_depth: float,
    max_depth: float,
) -> np.ndarray:
    """
    Planar depth [m] as a worse camera measures it, float32.

        z' = z (1 + depth_multiplicative n_1) + depth_additive n_2

    Pixels that read 0 or infinity keep that, and what an error takes out of the camera's range
    reads as Drake's cameras do: 0 below `min_depth`, infinity above `max_depth` [m]. Where
    u < depth_dropout a pixel reads infinity whatever it saw.

    Args:
        relative, absolute: n_1 and n_2, of the depth's shape, drawn from N(0, 1).
        drop: u, of the depth's shape, drawn from U(0, 1).
    """
    measured = np.isfinite(depth) & (depth > 0.0)
    z = np.where(measured, depth, 1.0).astype(float)
    z = z * (1.0 + noise.depth_multiplicative * relative) + noise.depth_additive * absolute
    z = np.where(z < min_depth, 0.0, np.where(z > max_depth, np.inf, z))
    dropped = drop < noise.depth_dropout
    return np.where(dropped, np.inf, np.where(measured, z, depth)).astype(np.float32)


def noisy_color(
    color: np.ndarray, noise: ObservationNoise, generator: np.random.Generator
) -> np.ndarray:
    """The colour image (H, W, 3) uint8, of other hue, blurred, brighter or darker as a whole, with
    noise at each pixel; see `turned_hue`, `expose` and `disturb_color`."""
    brighter = generator.uniform(-1.0, 1.0)
    grain = generator.standard_normal(color.shape, dtype=np.float32)
    if noise.hue_jitter > 0.0:
        turn = math.radians(noise.hue_jitter * generator.uniform(-1.0, 1.0))
        color = turned_hue(color.astype(np.float32), math.cos(turn), math.sin(turn))
    if noise.blur > 0.0:
        color = cv2.GaussianBlur(color.astype(np.float32), (0, 0), noise.blur)
    if noise.changes_light:
        error = np.float32(generator.uniform(-1.0, 1.0))
        photons = generator.standard_normal(color.shape, dtype=np.float32)
        color = expose(color.astype(np.float32), noise, error, photons)
    return disturb_color(color, noise, brighter, grain)


def turned_hue(color: Any, cos: Any, sin: Any) -> Any:
    """
    Colours (..., 3), 0 to 255, turned about grey: red towards green, green towards blue; clipped.
    Arrays or tensors, of floats. Rodrigues' formula with the axis k = (1, 1, 1) / sqrt(3).

        c' = clip(cos c + (1 - cos) (k · c) k + sin k x c)

    Args:
        cos, sin: of the angle, of shapes that broadcast.
    """
    grey = color.sum(-1)[..., None] / 3.0
    across = (color[..., [2, 0, 1]] - color[..., [1, 2, 0]]) / math.sqrt(3.0)
    return (cos * color + (1.0 - cos) * grey + sin * across).clip(0.0, 255.0)


def expose(color: Any, noise: ObservationNoise, error: Any, photons: Any) -> Any:
    """
    Colours (..., 3), 0 to 255, as a sensor counts their light. Arrays or tensors, of floats.

        light' = 2^(exposure_error u) (c / 255)^2.2
        c' = 255 clip(light' + n sqrt(light' / full_well + (read_noise / full_well)^2))^(1 / 2.2)

    Args:
        error: u, drawn from U(-1, 1) for each image, of a shape that broadcasts.
        photons: n, of the colours' shape, drawn from N(0, 1).
    """
    light = (color / 255.0) ** _GAMMA * 2.0 ** (noise.exposure_error * error)
    if noise.full_well > 0.0:
        variance = light / noise.full_well + (noise.read_noise / noise.full_well) ** 2
        light = light + photons * variance**0.5
    return 255.0 * light.clip(0.0, 1.0) ** (1.0 / _GAMMA)


def disturb_color(
    color: np.ndarray, noise: ObservationNoise, brighter: float, grain: np.ndarray
) -> np.ndarray:
    """
    Colours (..., 3), 0 to 255, as a worse camera measures them, uint8.

        c' = c (1 + brightness_jitter u) + 255 color_noise n

    Args:
        brighter: u, drawn from U(-1, 1) for each image.
        grain: n, of the colours' shape, drawn from N(0, 1).
    """
    gain = np.float32(1.0 + noise.brightness_jitter * brighter)
    noisy = gain * color + np.float32(255.0 * noise.color_noise) * grain
    return np.clip(noisy + np.float32(0.5), 0.0, 255.0).astype(np.uint8)


def image_generator(seed: int, number: int) -> np.random.Generator:
    """Where the randomness of image `number` of a flight comes from."""
    return np.random.default_rng([seed, number])


class DepthNoise(LeafSystem):
    """Adds errors and holes to depth images, see `noisy_depth`.

    .. pydrake_system::

        name: DepthNoise
        input_ports:
        - depth_image_32f
        output_ports:
        - depth_image_32f

    Both are planar depth [m]. Stateless: the noise is that of the seed and of the image's number,
    the time in units of 1 / `rate`, so that whoever looks again at the same time sees the same.
    """

    depth_image_32f_input_port = input_port("depth_image_32f")
    depth_image_32f_output_port = output_port("depth_image_32f")

    def __init__(
        self, noise: ObservationNoise, camera: OnboardCamera, rate: float, seed: int
    ) -> None:
        """Constructs the system.

        Args:
            noise: how much.
            camera: whose images; its size and range.
            rate: at which images are looked at [Hz].
            seed: of the flight.

        Raises:
            ValueError: on noise out of range.
        """
        super().__init__()
        noise.validate()
        self._noise, self._camera, self._rate, self._seed = noise, camera, rate, seed
        size = camera.width, camera.height
        self.DeclareAbstractInputPort("depth_image_32f", Value(ImageDepth32F(*size)))
        self.DeclareAbstractOutputPort(
            "depth_image_32f",
            alloc=lambda: Value(ImageDepth32F(*size)),
            calc=weakly(self._calc),
        )

    def _calc(self, context, output) -> None:
        image = cast(ImageDepth32F, self.get_input_port().Eval(context))
        number = round(context.get_time() * self._rate)
        output.get_mutable_value().mutable_data[..., 0] = noisy_depth(
            np.asarray(image.data)[..., 0],
            self._noise,
            image_generator(self._seed, number),
            self._camera.min_depth,
            self._camera.max_depth,
        )


class ColorNoise(LeafSystem):
    """Adds pixel noise and changes of brightness to colour images, see `noisy_color`.

    .. pydrake_system::

        name: ColorNoise
        input_ports:
        - color_image
        output_ports:
        - color_image

    Stateless: the noise is that of the seed and of the image's number, the time in units of
    1 / `rate`, so that whoever looks again at the same time sees the same. Alpha is passed on.
    """

    color_image_input_port = input_port("color_image")
    color_image_output_port = output_port("color_image")

    def __init__(
        self, noise: ObservationNoise, camera: OnboardCamera, rate: float, seed: int
    ) -> None:
        """Constructs the system.

        Args:
            noise: how much.
            camera: whose images; its size.
            rate: at which images are looked at [Hz].
            seed: of the flight.

        Raises:
            ValueError: on noise out of range.
        """
        super().__init__()
        noise.validate()
        self._noise, self._rate, self._seed = noise, rate, seed
        size = camera.width, camera.height
        self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U(*size)))
        self.DeclareAbstractOutputPort(
            "color_image", alloc=lambda: Value(ImageRgba8U(*size)), calc=weakly(self._calc)
        )

    def _calc(self, context, output) -> None:
        image = np.asarray(cast(ImageRgba8U, self.get_input_port().Eval(context)).data)
        generator = image_generator(self._seed, round(context.get_time() * self._rate))
        pixels = output.get_mutable_value().mutable_data  # (H, W, 4)
        pixels[..., :3] = noisy_color(image[..., :3], self._noise, generator)
        pixels[..., 3] = image[..., 3]
