"""DepthNoise: depth images as a real camera would give them."""

from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.observation_noise import (
    ObservationNoise,
    image_generator,
    noisy_depth,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.weakly import weakly


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
