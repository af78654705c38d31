"""What messages carry: the arrays of Drake's ports, each packed into its message and unpacked."""

import math
import secrets
import zlib
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from drake import lcmt_header, lcmt_image, lcmt_image_array
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.messaging.generated import (
    lcmt_body_rate_command,
    lcmt_bridge_status,
    lcmt_depth_grid,
    lcmt_motion_capture_pose,
    lcmt_quadrotor_state,
    lcmt_trajectory_hypotheses,
    lcmt_vehicle_status,
    lcmt_velocity_setpoint,
)
from splatpilot.systems.policies.hypotheses import (
    NUM_WAYPOINTS,
    WAYPOINT_PERIOD,
    Hypotheses,
    hypotheses_size,
)
from splatpilot.systems.vehicle.state import QuadrotorState

WORLD, BODY = "world", "body"  # What frames are called in headers.


class Codec:
    """
    How one signal travels: the channel of its messages, and from array to message and back.

    `unpack` raises ValueError, with the reason, for a message whose content cannot be used.
    """

    channel: ClassVar[str]
    port: ClassVar[str]
    """The name of the ports that carry the array."""
    message: ClassVar[Any]
    """The type of the messages."""
    frame: str = WORLD
    """`header.frame_name` of the messages."""
    size: int = 0
    """The length of the array; 0 of images."""
    image: ImageDepth32F | ImageRgba8U | None = None
    """An image like those that travel, of signals that are images."""

    @cached_property
    def session(self) -> int:
        """A random number by which subscribers tell two senders on one channel apart."""
        return secrets.randbits(31)

    def stamped(self, header: lcmt_header) -> Any:
        """An empty message with a header and, unless it is of images, the session."""
        message = self.message()
        message.header = header
        if self.image is None:
            message.session = self.session
        return message

    def pack(self, value: np.ndarray, header: lcmt_header, epoch: float) -> Any:
        """The message, or None where there is nothing to say yet; `epoch` is the Unix time [s] of
        the Context's time 0."""
        raise NotImplementedError

    def unpack(self, message: Any, epoch: float) -> np.ndarray:
        """The array of a message whose type and header are as they should be."""
        raise NotImplementedError


class StateCodec(Codec):
    """The state (13): p_WB [m], v_WB [m/s], q_WB (wxyz), w_WB_B [rad/s]."""

    channel, port, message, size = "QUADROTOR_STATE", "state", lcmt_quadrotor_state, 13

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.p_WB, message.v_WB, message.q_WB, message.w_WB_B = QuadrotorState.of(value)
        return message

    def unpack(self, message, epoch):
        require_unit_quaternion(message.q_WB)
        return finite([*message.p_WB, *message.v_WB, *message.q_WB, *message.w_WB_B])


class CommandCodec(Codec):
    """The command (4): thrust over mass [m/s^2] and body rates w_cmd_B [rad/s]."""

    channel, port, message, size = "BODY_RATE_COMMAND", "command", lcmt_body_rate_command, 4
    frame = BODY

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.thrust, message.w_cmd_B = value[0], value[1:]
        return message

    def unpack(self, message, epoch):
        return finite([message.thrust, *message.w_cmd_B])


class VelocitySetpointCodec(Codec):
    """The velocity setpoint (4): v_WB [m/s] and heading [rad], which is NaN where it is free."""

    channel, port, message, size = (
        "VELOCITY_SETPOINT",
        "velocity_setpoint",
        lcmt_velocity_setpoint,
        4,
    )

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.v_WB, message.heading = value[:3], value[3]
        return message

    def unpack(self, message, epoch):
        heading = message.heading
        if np.isinf(heading):
            raise ValueError(f"the heading is {heading}; it must be an angle, or NaN for none")
        return np.append(finite(message.v_WB), heading)


class HypothesesCodec(Codec):
    """A plan of K trajectories, see `splatpilot.systems.policies.hypotheses`."""

    channel, port, message = (
        "TRAJECTORY_HYPOTHESES",
        "hypotheses",
        lcmt_trajectory_hypotheses,
    )

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
        if message.num_hypotheses != self.num_hypotheses:
            raise ValueError(
                f"there are {message.num_hypotheses} hypotheses; there must be "
                f"{self.num_hypotheses}"
            )
        if message.waypoint_period != WAYPOINT_PERIOD:
            raise ValueError(
                f"waypoints are {message.waypoint_period} s apart; it must be {WAYPOINT_PERIOD} s"
            )
        require_unit_quaternion(message.q_WP)
        waypoints = np.reshape(message.waypoints_P, self.num_hypotheses * NUM_WAYPOINTS * 3)
        plan_time = message.plan_utime * 1e-6 - epoch
        return finite([plan_time, *message.p_WP, *message.q_WP, *waypoints, *message.costs])


class MotionCaptureCodec(Codec):
    """The pose (7) of a body in motion capture: p_WB [m] and q_WB (wxyz)."""

    channel, port, message, size = (
        "MOTION_CAPTURE_POSE",
        "motion_capture_pose",
        lcmt_motion_capture_pose,
        7,
    )

    def __init__(self, body: str):
        self.body = body

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.body = self.body
        message.tracked = bool(np.isfinite(value).all())
        message.p_WB, message.q_WB = value[:3], value[3:]
        return message

    def unpack(self, message, epoch):
        if message.body != self.body:
            raise ValueError(f"the body is {message.body!r}; it must be {self.body!r}")
        if not message.tracked:
            raise ValueError(f"motion capture does not see {self.body!r}")
        require_unit_quaternion(message.q_WB)
        return finite([*message.p_WB, *message.q_WB])


class DepthGridCodec(Codec):
    """The proximity 1 - range / max_range (height * width), row by row from the lowest."""

    channel, port, message = "DEPTH_GRID", "depth_grid", lcmt_depth_grid

    def __init__(self, width: int, height: int, max_range: float, frame: str):
        """
        Args:
            width, height: of the grid.
            max_range: [m], from which on nothing is near.
            frame: the name of the sensor.
        """
        self.width, self.height, self.max_range, self.frame = width, height, max_range, frame
        self.size = width * height

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.width, message.height = self.width, self.height
        message.max_range, message.encoding = self.max_range, lcmt_depth_grid.PROXIMITY
        message.num_values, message.values = self.size, value
        return message

    def unpack(self, message, epoch):
        is_so = message.width, message.height, message.num_values, message.encoding
        should_be = self.width, self.height, self.size, lcmt_depth_grid.PROXIMITY
        if is_so != should_be or message.max_range != np.float32(self.max_range):
            raise ValueError(
                f"width, height, number of values and encoding are {is_so} with a range of "
                f"{message.max_range} m; they must be {should_be} with {self.max_range} m"
            )
        values = finite(message.values)
        if values.min() < 0.0 or values.max() > 1.0:
            raise ValueError(f"values are {values.min()} to {values.max()}; they must be 0 to 1")
        return values


class StatusCodec(Codec):
    """The status (7): mode, reason, ages of state and observation [s], gaps, rejected, overruns."""

    channel, port, message, size = "BRIDGE_STATUS", "status", lcmt_bridge_status, 7
    frame = ""

    def pack(self, value, header, epoch):
        message = self.stamped(header)
        message.mode, message.reason = map(int, value[:2])
        message.state_age, message.observation_age = value[2:4]
        message.num_gaps, message.num_rejected, message.num_overruns = map(int, value[4:])
        return message

    def unpack(self, message, epoch):
        ages = message.state_age, message.observation_age
        counts = message.num_gaps, message.num_rejected, message.num_overruns
        return np.array([message.mode, message.reason, *ages, *counts], dtype=float)


class VehicleStatusCodec(Codec):
    """Who flies the vehicle (2): whether it is armed, and whether it flies by the bridge; NaN, of
    which there is no message, while that is unknown."""

    channel, port, message, size = "VEHICLE_STATUS", "vehicle_status", lcmt_vehicle_status, 2
    frame = ""

    def pack(self, value, header, epoch):
        if np.isnan(value).any():
            return None
        message = self.stamped(header)
        message.armed, message.offboard = map(bool, value)
        return message

    def unpack(self, message, epoch):
        return np.array([message.armed, message.offboard], dtype=float)


def finite(values: Any) -> np.ndarray:
    """The values as an array.

    Raises:
        ValueError: if one is infinite or not a number.
    """
    array = np.asarray(values, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"values are {array.tolist()}; they must be finite")
    return array


def require_unit_quaternion(q: Any) -> None:
    """Raises ValueError unless the quaternion has length 1, within 0.01."""
    length = math.hypot(*q)
    if not abs(length - 1.0) < 0.01:
        raise ValueError(f"the quaternion {list(q)} has length {length}; it must be 1")


class ImageCodec(Codec):
    """An image (height, width, channels), sent with zlib, and understood without it too."""

    message = lcmt_image_array
    _format: int
    _type: int

    def __init__(self, image: ImageDepth32F | ImageRgba8U, frame: str):
        """
        Args:
            image: one of the size of those that travel.
            frame: the name of the camera.
        """
        self.image, self.frame = image, frame

    def pack(self, value, header, epoch):
        image = lcmt_image()
        image.header = header
        image.height, image.width, _ = value.shape
        # Compressed, because Drake reads but a quarter of depth images that are not.
        image.data = zlib.compress(value.astype(value.dtype.newbyteorder("<")).tobytes(), level=1)
        image.size, image.row_stride = len(image.data), value.nbytes // image.height
        image.pixel_format, image.channel_type = self._format, self._type
        image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
        message = self.stamped(header)
        message.num_images, message.images = 1, [image]
        return message

    def unpack(self, message, epoch):
        if message.num_images != 1:
            raise ValueError(f"there are {message.num_images} images; there must be one")
        [image] = message.images
        assert self.image is not None
        pixels = np.asarray(self.image.data)
        is_so = image.width, image.height, image.pixel_format, image.channel_type
        should_be = self.image.width(), self.image.height(), self._format, self._type
        if is_so != should_be:
            raise ValueError(
                f"width, height, pixel format and channel type are {is_so}; they must be "
                f"{should_be}"
            )
        data = bytes(image.data)
        if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, pixels.nbytes)
            except zlib.error as error:
                raise ValueError(f"the image is compressed, and damaged: {error}") from None
        elif image.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
            raise ValueError(
                f"the compression method is {image.compression_method}; send images as they are, "
                "or with zlib"
            )
        if len(data) != pixels.nbytes:
            raise ValueError(f"the image has {len(data)} bytes; it must have {pixels.nbytes}")
        order = ">" if image.bigendian else "<"
        return np.frombuffer(data, pixels.dtype.newbyteorder(order)).reshape(pixels.shape)


class DepthImageCodec(ImageCodec):
    """Planar depth [m] as float32."""

    channel, port = "DEPTH_IMAGE", "depth_image_32f"
    _format, _type = lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_FLOAT32

    def unpack(self, message, epoch):
        depth = super().unpack(message, epoch)
        if not (depth >= 0.0).all():
            raise ValueError("depths are negative or not numbers; they must be at least 0 m")
        return depth


class ColorImageCodec(ImageCodec):
    """Red, green, blue and opacity, 8 bits each."""

    channel, port = "COLOR_IMAGE", "color_image"
    _format, _type = lcmt_image.PIXEL_FORMAT_RGBA, lcmt_image.CHANNEL_TYPE_UINT8
