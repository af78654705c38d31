"""Image formation of a policy's camera: exposure, lens, compression and depth sensor."""

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import cv2
import numpy as np
from pydrake.common.schema import Transform
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import weak_callback
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.sensing.depth_sensors import (
    Stereo,
    TimeOfFlightErrors,
    matched_depth,
    stereo_depth,
    time_of_flight_depth,
)
from splatpilot.systems.sensing.noise import (
    ImageChange,
    color_of_light,
    light_of_color,
    limit_depth,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

_LIGHT = light_of_color(np.arange(256, dtype=np.float32))
_MAX_GAIN = 4.0  # [EV] of automatic exposure, up and down


@dataclass
class Imaging(Config):
    """Image formation of the policy's camera; the defaults change nothing."""

    # [s] Exposure, over which color images blur by motion; below the period of the images.
    exposure_time: float = bounded(0.0, "[0, 0.2] s")
    # [s] Time constant of automatic exposure; 0 is a fixed exposure.
    exposure_response: float = bounded(0.0, "[0, 10] s")
    # [-] Mean light of an image at which automatic exposure aims; 0.18 is photographic gray.
    exposure_target: float = bounded(0.18, "(0, 1)")
    # [-] Exponent n of vignetting: light falls by cos^n of the angle from the axis. 4 is natural.
    vignetting: float = bounded(0.0, "[0, 8]")
    # Quality of JPEG compression; without compression if left out.
    jpeg_quality: int | None = bounded(None, "[1, 100]")
    # [-] True focal length over that of the policy's camera. 0.75 to 1.5 turn a field of view of 90
    # degrees into 106 to 67.
    focal_scale: float = bounded(1.0, "[0.3, 3]")
    # Stereo camera of depth images; exact depth if left out.
    stereo: Stereo | None = None
    # Time-of-flight camera of depth grids, and of depth images without `stereo`.
    time_of_flight: TimeOfFlightErrors | None = None

    @property
    def changes_light(self) -> bool:
        """True if `AutoExposure` changes color images."""
        return max(self.exposure_response, self.vignetting) > 0.0

    def camera(self, nominal: OnboardCamera) -> OnboardCamera:
        """Returns the true camera of a nominal one."""
        if self.focal_scale == 1.0:
            return nominal

        def scaled(fov: float | None) -> float | None:
            slope = None if fov is None else math.tan(math.radians(0.5 * fov))
            return slope and math.degrees(2.0 * math.atan(slope / self.focal_scale))

        fov_x, fov_y = scaled(nominal.fov_x), scaled(nominal.fov_y)
        return replace(nominal, fov_x=cast(float, fov_x), fov_y=fov_y)

    def depth_sensor(self, is_grid: bool) -> Stereo | TimeOfFlightErrors | None:
        """Returns the sensor of depth grids or else of depth images."""
        stereo = None if is_grid else self.stereo
        return stereo or self.time_of_flight


class AutoExposure(LeafSystem):
    """Controls the exposure of color images, and darkens their corners.

    .. pydrake_system::

        name: AutoExposure
        input_ports: [color_image]
        output_ports: [color_image]

    With the gain g [EV], the discrete state, an image has the light

        light' = 2^g cos(angle)^vignetting light.

    Each `period` [s], g approaches log2(exposure_target / mean light), of the light before gain,
    with the time constant `exposure_response`; at time 0 it is there.
    """

    def __init__(self, imaging: Imaging, camera: OnboardCamera, period: float) -> None:
        super().__init__()
        imaging.validate()
        self._imaging = imaging
        slopes = camera.ray_slopes()
        cos = 1.0 / np.linalg.norm(slopes, axis=-1, keepdims=True)
        self._falloff = (cos**imaging.vignetting).astype(np.float32)
        blank = ImageRgba8U(camera.width, camera.height)
        self.DeclareAbstractInputPort("color_image", Value(blank))
        self.DeclareAbstractOutputPort(
            "color_image", lambda: Value(blank), weak_callback(self._calc)
        )
        self.DeclareDiscreteState(1)
        if imaging.exposure_response > 0.0:
            self._share = 1.0 - math.exp(-period / imaging.exposure_response)
            self.DeclareInitializationDiscreteUpdateEvent(self._begin)
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _light(self, context: Context) -> np.ndarray:
        image = np.asarray(cast(Any, self.get_input_port().Eval(context)).data)
        return self._falloff * cv2.LUT(np.ascontiguousarray(image[..., :3]), _LIGHT)

    def _target(self, context: Context) -> float:
        """Returns the gain [EV] with which the image would have the target's mean light."""
        mean = max(float(self._light(context).mean()), 1e-6)
        gain = math.log2(self._imaging.exposure_target / mean)
        return min(max(gain, -_MAX_GAIN), _MAX_GAIN)

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(np.array([self._target(context)]))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        gain = context.get_discrete_state_vector().GetAtIndex(0)
        gain += self._share * (self._target(context) - gain)
        discrete_state.set_value(np.array([gain]))

    def _calc(self, context: Context, output: AbstractValue) -> None:
        gain = context.get_discrete_state_vector().GetAtIndex(0)
        color = color_of_light(self._light(context) * np.float32(2.0**gain))
        pixels = cast(Any, output.get_mutable_value()).mutable_data
        pixels[..., :3], pixels[..., 3] = color + np.float32(0.5), 255


class Compression(ImageChange):
    """Compresses ``color_image`` by JPEG, see `Imaging.jpeg_quality`."""

    port, image = "color_image", ImageRgba8U

    def changed(self, image: np.ndarray, random: np.random.Generator) -> np.ndarray:
        quality = [cv2.IMWRITE_JPEG_QUALITY, cast(int, self.config.jpeg_quality)]
        _, data = cv2.imencode(".jpg", image[..., 2::-1], quality)
        color = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
        return np.dstack([color[..., ::-1], image[..., 3]])


class StereoMatcher(LeafSystem):
    """Measures depth by matching images, see `matched_depth`.

    .. pydrake_system::

        name: StereoMatcher
        input_ports: [left_image, right_image]
        output_ports: [depth_image_32f]

    The depth is that of the `camera`; the images are of `cameras`.
    """

    def __init__(self, sensor: Stereo, camera: OnboardCamera) -> None:
        super().__init__()
        sensor.validate()
        self._sensor, self._camera = sensor, camera
        for name, config in self.cameras(sensor, camera).items():
            self.DeclareAbstractInputPort(name, Value(ImageRgba8U(config.width, config.height)))
        depth = ImageDepth32F(camera.width, camera.height)
        calc = weak_callback(self._calc)
        self.DeclareAbstractOutputPort("depth_image_32f", lambda: Value(depth), calc)

    @staticmethod
    def cameras(sensor: Stereo, camera: OnboardCamera) -> dict[str, OnboardCamera]:
        """Returns the cameras of the images, by the names of the inputs."""
        height = round(camera.height * sensor.width / camera.width)
        left = replace(camera, width=sensor.width, height=height)
        X_BR = camera.mount() @ RigidTransform(np.array([sensor.baseline, 0.0, 0.0]))
        return {"left_image": left, "right_image": replace(left, X_BC=Transform(X_BR))}

    def _calc(self, context: Context, output: AbstractValue) -> None:
        left, right = (
            cv2.cvtColor(
                np.asarray(cast(Any, self.get_input_port(k).Eval(context)).data),
                cv2.COLOR_RGBA2GRAY,
            )
            for k in range(2)
        )
        z = matched_depth(left, right, self._sensor, self._camera)
        z = limit_depth(z, self._camera.min_depth, self._camera.max_depth)
        cast(Any, output.get_mutable_value()).mutable_data[..., 0] = z


class DepthSensor(ImageChange):
    """Measures ``depth_image_32f`` [m] as a sensor does, see `stereo_depth` and
    `time_of_flight_depth`."""

    port, image, stream = "depth_image_32f", ImageDepth32F, (1,)

    def changed(self, image: np.ndarray, random: np.random.Generator) -> np.ndarray:
        depth, sensor, camera = image[..., 0], self.config, self.camera
        noise, reflectivity = random.standard_normal((2, *depth.shape), dtype=np.float32)
        if isinstance(sensor, Stereo):
            z = stereo_depth(depth, sensor, camera, noise)
        else:
            mixing = random.random((2, *depth.shape), dtype=np.float32)
            z = time_of_flight_depth(depth, sensor, camera, noise, reflectivity, mixing)
        return limit_depth(z, camera.min_depth, camera.max_depth)[..., None]
