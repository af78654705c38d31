"""Codecs: conversion between vectors or images and LCM messages."""

import secrets
import zlib
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from drake import lcmt_header, lcmt_image, lcmt_image_array
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.validation import require
from splatpilot.systems.messaging import generated
from splatpilot.systems.policies.hypotheses import (
    NUM_WAYPOINTS,
    WAYPOINT_PERIOD,
    Hypotheses,
    hypotheses_size,
)


class Codec:
    """Converts a signal to messages of one channel and back. By default the signal is a vector of
    the message's `fields`, in their order. Quaternions (q_...) have length 1, and numbers are
    finite, but those of `unbounded` fields."""

    channel: ClassVar[str]
    port: ClassVar[str]  # Name of the ports of the signal.
    message: ClassVar[Any]  # Type of the messages.
    fields: ClassVar[tuple[str, ...]] = ()
    unbounded: ClassVar[tuple[str, ...]] = ()
    frame: str = "world"  # `header.frame_name` of the messages.
    size: int = 0  # of the vector; 0 of images.
    image: ImageDepth32F | ImageRgba8U | None = None  # Example of the image; None of vectors.

    @cached_property
    def session(self) -> int:
        """A random number that distinguishes two senders on one channel."""
        return secrets.randbits(31)

    def stamped(self, header: lcmt_header) -> Any:
        """Returns an empty message with a header and, except of images, the session."""
        message = self.message()
        message.header = header
        if self.image is None:
            message.session = self.session
        return message

    def pack(self, value: np.ndarray, header: lcmt_header, epoch: float) -> Any:
        """Returns the message, or None without a value yet; `epoch` is the Unix time [s] of the
        Context's time 0."""
        message, numbers = self.stamped(header), iter(value.tolist())
        for name in self.fields:
            default = getattr(message, name)
            is_list = isinstance(default, list)
            part = [next(numbers) for _ in default] if is_list else type(default)(next(numbers))
            setattr(message, name, part)
        return message

    def unpack(self, message: Any, epoch: float) -> np.ndarray:
        """Returns the array of a message of the right type and frame; raises ValueError for invalid
        content."""
        parts = {name: np.ravel(getattr(message, name)).astype(float) for name in self.fields}
        for name, part in parts.items():
            if name.startswith("q_"):
                require_unit_quaternion(part)
            if name not in self.unbounded:
                finite(part)
        return np.concatenate([*parts.values()])


class StateCodec(Codec):
    """State (13): p_WB [m], v_WB [m/s], q_WB (wxyz), w_WB_B [rad/s]."""

    channel, port, message, size = "QUADROTOR_STATE", "state", generated.lcmt_quadrotor_state, 13
    fields = "p_WB", "v_WB", "q_WB", "w_WB_B"


class CommandCodec(Codec):
    """Command (4): thrust over mass [m/s^2] and body rates w_cmd_B [rad/s]."""

    channel, port, size, frame = "BODY_RATE_COMMAND", "command", 4, "body"
    message, fields = generated.lcmt_body_rate_command, ("thrust", "w_cmd_B")


class VelocitySetpointCodec(Codec):
    """Velocity setpoint (4): v_WB [m/s] and heading [rad], NaN if it is free."""

    channel, port, size = "VELOCITY_SETPOINT", "velocity_setpoint", 4
    message, fields, unbounded = generated.lcmt_velocity_setpoint, ("v_WB", "heading"), ("heading",)

    def unpack(self, message, epoch):
        valid = not np.isinf(message.heading)
        require(valid, "the heading", "finite or NaN", message.heading)
        return super().unpack(message, epoch)


class MotionCaptureCodec(Codec):
    """Pose (7) of a body in motion capture: p_WB [m] and q_WB (wxyz)."""

    channel, port, size = "MOTION_CAPTURE_POSE", "motion_capture_pose", 7
    message, fields = generated.lcmt_motion_capture_pose, ("p_WB", "q_WB")

    def __init__(self, body: str):
        self.body = body

    def pack(self, value, header, epoch):
        message = super().pack(value, header, epoch)
        message.body, message.tracked = self.body, bool(np.isfinite(value).all())
        return message

    def unpack(self, message, epoch):
        _require_equal("the body", message.body, self.body)
        require(message.tracked, f"body {self.body!r}", "tracked", "an untracked pose")
        return super().unpack(message, epoch)


class StatusCodec(Codec):
    """Status (7): mode, reason, ages of state and observation [s], gaps, rejected, overruns."""

    channel, port, message, size = "BRIDGE_STATUS", "status", generated.lcmt_bridge_status, 7
    fields = (
        *("mode", "reason", "state_age", "observation_age"),
        *("num_gaps", "num_rejected", "num_overruns"),
    )
    unbounded, frame = ("state_age", "observation_age"), ""


class VehicleStatusCodec(Codec):
    """Vehicle status (2): 1 if it is armed, and 1 if it obeys the bridge; NaN, which is not sent,
    if unknown."""

    channel, port, size, frame = "VEHICLE_STATUS", "vehicle_status", 2, ""
    message, fields = generated.lcmt_vehicle_status, ("armed", "offboard")

    def pack(self, value, header, epoch):
        return None if np.isnan(value).any() else super().pack(value, header, epoch)


class HypothesesCodec(Codec):
    """Plan of K trajectories, see `splatpilot.systems.policies.hypotheses`."""

    channel, port = "TRAJECTORY_HYPOTHESES", "hypotheses"
    message = generated.lcmt_trajectory_hypotheses

    def __init__(self, num_hypotheses: int):
        self.num_hypotheses, self.size = num_hypotheses, hypotheses_size(num_hypotheses)

    def pack(self, value, header, epoch):
        plan = Hypotheses.from_vector(value, self.num_hypotheses)
        if plan is None:
            return None
        message = self.stamped(header)
        message.plan_utime = round((epoch + plan.plan_time) * 1e6)
        message.waypoint_period = WAYPOINT_PERIOD
        message.p_WP = plan.X_WB.translation()
        message.q_WP = plan.X_WB.rotation().ToQuaternion().wxyz()
        message.num_hypotheses = self.num_hypotheses
        message.waypoints_P, message.costs = plan.waypoints_B, plan.costs
        return message

    def unpack(self, message, epoch):
        _require_equal("num_hypotheses", message.num_hypotheses, self.num_hypotheses)
        _require_equal("waypoint_period", message.waypoint_period, WAYPOINT_PERIOD)
        require_unit_quaternion(message.q_WP)
        waypoints = np.reshape(message.waypoints_P, self.num_hypotheses * NUM_WAYPOINTS * 3)
        plan_time = message.plan_utime * 1e-6 - epoch
        return finite([plan_time, *message.p_WP, *message.q_WP, *waypoints, *message.costs])


class DepthGridCodec(Codec):
    """Proximity 1 - range / max_range (height * width) of a sensor, `frame`, row by row from the
    lowest."""

    channel, port, message = "DEPTH_GRID", "depth_grid", generated.lcmt_depth_grid

    def __init__(self, width: int, height: int, max_range: float, frame: str):
        self.size, self.frame = width * height, frame
        max_range, encoding = float(np.float32(max_range)), self.message.PROXIMITY
        self._content = {
            **{"width": width, "height": height, "num_values": self.size},
            **{"encoding": encoding, "max_range": max_range},
        }

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.values = value
        for name, content in self._content.items():
            setattr(message, name, content)
        return message

    def unpack(self, message, epoch):
        for name, content in self._content.items():
            _require_equal(name, getattr(message, name), content)
        values = finite(message.values)
        low, high = values.min(), values.max()
        require(low >= 0.0 and high <= 1.0, "values", "in [0, 1]", f"{low} to {high}")
        return values


class ImageCodec(Codec):
    """Image (height, width, channels) as an example, of a camera, `frame`; sent with zlib, received
    with or without it."""

    message = lcmt_image_array
    _format: int
    _type: int

    def __init__(self, image: ImageDepth32F | ImageRgba8U, frame: str):
        self.image, self.frame = image, frame

    def pack(self, value, header, epoch):
        image = lcmt_image()
        image.header = header
        image.height, image.width, _ = value.shape
        # Drake reads only a quarter of uncompressed depth images.
        image.data = zlib.compress(value.astype(value.dtype.newbyteorder("<")).tobytes(), level=1)
        image.size, image.row_stride = len(image.data), value.nbytes // image.height
        image.pixel_format, image.channel_type = self._format, self._type
        image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
        message = self.stamped(header)
        message.num_images, message.images = 1, [image]
        return message

    def unpack(self, message, epoch):
        _require_equal("num_images", message.num_images, 1)
        [image] = message.images
        assert self.image is not None
        pixels = np.asarray(self.image.data)
        _require_equal(
            "(width, height, pixel format, channel type)",
            (image.width, image.height, image.pixel_format, image.channel_type),
            (self.image.width(), self.image.height(), self._format, self._type),
        )
        data, method = bytes(image.data), image.compression_method
        if method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, pixels.nbytes)
            except zlib.error as error:
                raise ValueError(f"the compressed image is invalid: {error}") from None
        else:
            uncompressed = method == lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
            require(uncompressed, "the compression method", "none or zlib", method)
        _require_equal("bytes of the image", len(data), pixels.nbytes)
        order = ">" if image.bigendian else "<"
        return np.frombuffer(data, pixels.dtype.newbyteorder(order)).reshape(pixels.shape)


class DepthImageCodec(ImageCodec):
    """Planar depth [m] as float32."""

    channel, port = "DEPTH_IMAGE", "depth_image_32f"
    _format, _type = lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_FLOAT32

    def unpack(self, message, epoch):
        depth = super().unpack(message, epoch)
        require((depth >= 0.0).all(), "depths", "at least 0 m", "negative ones or NaN")
        return depth


class ColorImageCodec(ImageCodec):
    """RGB and opacity, 8 bits each."""

    channel, port = "COLOR_IMAGE", "color_image"
    _format, _type = lcmt_image.PIXEL_FORMAT_RGBA, lcmt_image.CHANNEL_TYPE_UINT8


def finite(values: Any) -> np.ndarray:
    """Converts values to an array; raises ValueError if one is not finite."""
    array = np.asarray(values, dtype=float)
    require(np.isfinite(array).all(), "values", "finite", array.tolist())
    return array


def require_unit_quaternion(q: Any) -> None:
    """Raises ValueError unless the quaternion has length 1, within 0.01."""
    is_unit = abs(np.linalg.norm(q) - 1.0) < 0.01
    require(is_unit, "the attitude", "a unit quaternion", np.asarray(q).tolist())


def _require_equal(name: str, value: Any, expected: Any) -> None:
    require(value == expected, name, repr(expected), repr(value))
