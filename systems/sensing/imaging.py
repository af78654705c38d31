"""Image formation of a policy's camera: exposure, lens, compression and depth sensor.

Stereo and time-of-flight cameras change exact planar depth; pixels without a measurement read
infinity.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import cv2
import numpy as np
from pydrake.common.schema import Transform
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U
from scipy.ndimage import gaussian_filter

from splatpilot.systems.common.drake import weak_callback
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.sensing.noise import (
    ImageChange,
    color_of_light,
    light_of_color,
    limit_depth,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera


@dataclass
class Stereo(Config):
    """A stereo camera, see `stereo_depth`.

    The baseline of 50 mm and the size of 848x480 are those that Intel gives for the RealSense D435
    ("Tuning depth cameras for best performance"). Noise, step, range and window are our choice, of
    a usual size.
    """

    # [m] Distance of the right camera from the left, which takes the depth image.
    baseline: float = bounded(0.05, "(0, 1] m")
    # [px] Width of the images that are matched.
    width: int = bounded(848, "[1, 8192] px")
    # [px] Standard deviation of disparities; below 0.1 on textured surfaces.
    noise: float = bounded(0.08, "[0, 10] px")
    # [px] Step of disparities; 0 is without rounding.
    step: float = bounded(0.03125, "[0, 1] px")
    # [px] Maximum disparity; nearer surfaces are not measured.
    max_disparity: float = bounded(126.0, "(0, inf) px")
    # [px] Standard deviation of the window of matching, within which errors agree.
    window: float = bounded(9.0, "[0, 100] px")
    # Renders and matches the images of both cameras, instead of the formula of errors; see
    # `matched_depth`. It takes several times as long as the flight.
    matching: bool = False


@dataclass
class TimeOfFlightErrors(Config):
    """Errors of a time-of-flight camera, see `time_of_flight_depth`.

    The defaults are our choice for a small camera indoors: 1 % noise, a range of 7 m, and errors of
    a few centimeters in corners at 2 m.
    """

    # [-] Standard deviation of the noise, relative to depth.
    noise: float = bounded(0.01, "[0, 1]")
    # [m] Range at which ambient light hides the echo; 2 m to 3 m in sunlight.
    ambient_range: float = bounded(7.0, "(0, inf) m")
    # [-] Spread of that range between pixels, by their reflectivity; a standard deviation.
    ambient_spread: float = bounded(0.1, "[0, 1]")
    # [-] Strength of the light that takes a detour in concave corners.
    multipath: float = bounded(0.3, "[0, 1]")
    # [deg] Half the angle of the surface from which such light comes.
    multipath_angle: float = bounded(5.0, "[0, 45] deg")
    # [-] Probability that a pixel at an edge reads a depth between near and far.
    mixed_pixels: float = bounded(0.5, "[0, 1]")


_BLOCK = 5  # [px] matched windows
_EDGE = 0.2  # [-] relative step of depth from which neighbors are different surfaces


def correlated_noise(white: np.ndarray, sigma: float) -> np.ndarray:
    """Correlates white noise (H, W) by a Gaussian of `sigma` [px]; its variance stays."""
    if sigma < 0.1:
        return white
    return gaussian_filter(white, sigma, mode="wrap") / _filtered_deviation(white.shape, sigma)


@cache
def _filtered_deviation(shape: tuple[int, int], sigma: float) -> float:
    point = np.zeros(shape)
    point[0, 0] = 1.0
    return float(np.linalg.norm(gaussian_filter(point, sigma, mode="wrap")))


def stereo_depth(
    depth: np.ndarray, sensor: Stereo, camera: OnboardCamera, noise: np.ndarray
) -> np.ndarray:
    """Computes the depth (H, W) [m] that matching measures; `noise` n (H, W) is drawn from N(0, 1).

    With the focal length f [px] at the sensor's width and the baseline b,

        d = round((f b / z + noise n) / step) step,  z' = f b / d.

    A pixel is not measured if d is above `max_disparity` or not positive, if its match lies beyond
    the left border of the right image, or if a nearer surface hides it from the right camera.
    """
    pixels = sensor.width / camera.width  # of the sensor in one of the camera
    fb = camera.focal_x * pixels * sensor.baseline
    measured = np.isfinite(depth) & (depth > 0.0)
    exact = fb / _known_depth(depth, camera, np.inf)
    columns = (np.arange(depth.shape[1]) + 0.5) * pixels
    seen = columns - exact  # columns in the right image
    right = np.minimum.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, dtype=bool)
    hidden[:, :-1] = right[:, 1:] <= seen[:, :-1]
    errors = correlated_noise(noise, sensor.window / pixels)
    disparity = exact + sensor.noise * errors
    if sensor.step > 0.0:
        disparity = np.round(disparity / sensor.step) * sensor.step
    valid = (disparity > 0.0) & (disparity <= sensor.max_disparity) & (seen >= 0.0) & ~hidden
    z = fb / np.where(disparity > 0.0, disparity, 1.0)
    return np.where(measured, np.where(valid, z, np.inf), depth)


def matched_depth(
    left: np.ndarray, right: np.ndarray, sensor: Stereo, camera: OnboardCamera
) -> np.ndarray:
    """Computes the depth (H, W) [m] of a camera by semi-global matching of two gray images (h,
    `width`) of uint8, from the camera and from `baseline` to its right.

    Each pixel has the depth in its middle. Those without a match are not measured.
    """
    count = 16 * int(np.ceil(sensor.max_disparity / 16.0))
    matcher = cv2.StereoSGBM.create(
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # Without a margin, OpenCV leaves out the left border as wide as `count`.
    left, right = (
        cv2.copyMakeBorder(x, 0, 0, count, 0, cv2.BORDER_CONSTANT) for x in (left, right)
    )
    disparity = matcher.compute(left, right)[:, count:] / np.float32(16.0)
    rows, columns = (
        ((np.arange(n) + 0.5) * size / n).astype(int)
        for n, size in zip((camera.height, camera.width), disparity.shape, strict=True)
    )
    disparity = disparity[np.ix_(rows, columns)]
    fb = camera.focal_x * sensor.width / camera.width * sensor.baseline
    valid = (disparity > 0.0) & (disparity <= sensor.max_disparity)
    return np.where(valid, fb / np.where(valid, disparity, 1.0), np.inf)


def time_of_flight_depth(
    depth: np.ndarray,
    sensor: TimeOfFlightErrors,
    camera: OnboardCamera,
    noise: np.ndarray,
    reflectivity: np.ndarray,
    mixing: np.ndarray,
) -> np.ndarray:
    """Computes the depth (H, W) [m] that a time-of-flight camera measures.

        z' = (z + multipath s)(1 + noise n)

    s = z (z / c - 1) is the sag of a concave corner, zero on planes; c is the depth of the chord
    between the points at `multipath_angle` to the left and right, or above and below. At an edge, a
    pixel reads a depth between those of its neighbors with the probability `mixed_pixels`. A pixel
    is not measured if z' (1 + ambient_spread r) is above `ambient_range`.

    Args:
        noise, reflectivity: n and r (H, W), drawn from N(0, 1).
        mixing: (2, H, W), drawn from U(0, 1).
    """
    measured = np.isfinite(depth) & (depth > 0.0)
    z = _known_depth(depth, camera, sensor.ambient_range)
    z = z * (1.0 + sensor.multipath * _relative_sag(z, sensor.multipath_angle, camera))
    kernel = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(z, kernel), cv2.dilate(z, kernel)
    mixed = (far > (1.0 + _EDGE) * near) & (mixing[0] < sensor.mixed_pixels)
    z = np.where(mixed, near + mixing[1] * (far - near), z) * (1.0 + sensor.noise * noise)
    lost = z * (1.0 + sensor.ambient_spread * reflectivity) > sensor.ambient_range
    return np.where(measured, np.where(lost, np.inf, z), depth)


def _known_depth(depth: np.ndarray, camera: OnboardCamera, far: float) -> np.ndarray:
    """Returns a depth image whose zeros, surfaces too near, are at the minimum, and infinity at
    `far` [m]."""
    near = np.where(depth > 0.0, depth, np.float32(camera.min_depth or far))
    return np.where(np.isfinite(depth), near, np.float32(far))


def _require_pinhole(what: str, camera: OnboardCamera) -> None:
    condition = "of a camera without distortion"
    require(camera.distortion is None, what, condition, camera.distortion)


def _relative_sag(z: np.ndarray, angle: float, camera: OnboardCamera) -> np.ndarray:
    """Returns the sag of corners over z, 0 at the border: inverse depth is affine on a plane."""
    sag = np.zeros_like(z)
    for focal, depth, found in ((camera.focal_y, z, sag), (camera.focal_x, z.T, sag.T)):
        offset = round(focal * np.tan(np.radians(angle)))
        if not 0 < 2 * offset < len(depth):
            continue
        before, after = 1.0 / depth[: -2 * offset], 1.0 / depth[2 * offset :]
        relative = 0.5 * depth[offset:-offset] * (before + after) - 1.0
        edges = np.abs(before - after) > _EDGE * (before + after)
        relative[edges | (relative > _EDGE)] = 0.0
        inner = found[offset:-offset]  # a view
        np.maximum(inner, relative, out=inner)
    return sag


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
        _require_pinhole("imaging.focal_scale", nominal)

        def scaled(fov: float) -> float:
            slope = math.tan(math.radians(0.5 * fov))
            return math.degrees(2.0 * math.atan(slope / self.focal_scale))

        fov_y = None if nominal.fov_y is None else scaled(nominal.fov_y)
        return replace(nominal, fov_x=scaled(nominal.fov_x), fov_y=fov_y)

    def depth_sensor(
        self, is_grid: bool, camera: OnboardCamera
    ) -> Stereo | TimeOfFlightErrors | None:
        """Returns the sensor of depth grids or else of depth images of a camera."""
        stereo = None if is_grid else self.stereo
        if stereo is not None:
            _require_pinhole("imaging.stereo", camera)
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
        cos = np.nan_to_num(1.0 / np.linalg.norm(slopes, axis=-1, keepdims=True))
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
