"""ColorNoise: colour images as a real camera would give them."""

from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.observation_noise import (
    ObservationNoise,
    image_generator,
    noisy_color,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.weakly import weakly


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
