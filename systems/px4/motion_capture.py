"""MotionCaptureReceiver: receives the vehicle's pose from OptiTrack."""

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.messaging.receiver import RESTART, Received, Receiver, UdpConfig, UdpInbox
from splatpilot.systems.px4.mavlink import pose_from_optitrack

_FRAME_OF_DATA = 7  # NatNet's number of the messages that carry poses.


@dataclass
class MotionCaptureConfig(Config):
    """OptiTrack's stream, which Motive sends to a multicast group."""

    udp: UdpConfig = field(default_factory=lambda: UdpConfig(port=1511, group="239.255.42.99"))
    # Streaming ID of the vehicle's rigid body.
    body_id: int = 1
    # Version of the protocol, from Motive's settings for streaming.
    version: list[int] = field(default_factory=lambda: [4, 1])
    # [s] Age of a frame on arrival, from the exposure on.
    latency: float = bounded(0.01, "[0, 1] s")

    def check(self) -> None:
        valid = len(self.version) == 2 and [2, 6] <= self.version <= [4, 99]
        require_field(self, "version", valid, "two numbers from [2, 6] on, as [4, 1]")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pose(Received):
    pose: np.ndarray = field(default_factory=lambda: np.full(7, math.nan))
    time: float = -math.inf  # [s] Unix time of the last exposure that shows the body.
    number: int = -1  # of the last frame.
    came: float = -math.inf  # [s] Unix time of its arrival.


class MotionCaptureReceiver(Receiver[_Pose]):
    """Outputs the pose of a rigid body in OptiTrack's stream, in our frames.

    .. pydrake_system::

        name: MotionCaptureReceiver
        input_ports: [unix_time]
        output_ports: [motion_capture_pose, age, rejected]

    - ``motion_capture_pose`` (7): last p_WB [m] and q_WB (wxyz) of the tracked body; NaN before.
    - ``age`` (1): [s] since the exposure of that; infinity before.
    - ``rejected`` (1): number of packets that were not frames, of other senders, or no newer than
      the frame before.
    """

    def __init__(
        self, config: MotionCaptureConfig, period: float, now: Callable[[], float] | None = None
    ):
        config.validate()
        natnet: Any = import_extra("natnet", "mocap")
        super().__init__(_Pose(), "motion capture", period, now)
        self._body, self._version = config.body_id, natnet.Version(*config.version)
        self._natnet, self._inbox, self._latency = natnet, UdpInbox(config.udp), config.latency
        self.port = self._inbox.port
        weakref.finalize(self, self._inbox.close)
        self._declare_age(lambda received: received.time)
        self._declare("motion_capture_pose", 7, lambda received, _: received.pose)

    def _receive(self, context: Context, received: _Pose) -> _Pose:
        datagrams, now = self._inbox.receive(), self._time_of_reading(context)

        def read(last: _Pose, packet: bytes) -> _Pose:
            try:
                frame = self._frame(packet)
                pose = None if frame is None else self._pose(frame)
            except Exception as error:  # natnet raises any type for bytes that are not a frame.
                raise ValueError(f"the packet must be a NatNet frame, got {error}") from None
            if frame is None:
                return last
            number = frame.prefix.frame_number
            is_new = number > last.number or now - last.came > RESTART
            require(is_new, "frame", f"newer than {last.number}", number)
            last = replace(last, number=number, came=now)
            return last if pose is None else replace(last, pose=pose, time=now - self._latency)

        return self._take(received, *datagrams, read)

    def _frame(self, packet: bytes) -> Any:
        """Reads a frame of data; returns None for other types of messages."""
        buffer = self._natnet.PacketBuffer(packet)
        kind, size = buffer.read_uint16(), buffer.read_uint16()
        require(size == len(packet) - 4, "the packet", f"of {size + 4} bytes", len(packet))
        if kind != _FRAME_OF_DATA:
            return None
        return self._natnet.DataFrame.read_from_buffer(buffer, self._version)

    def _pose(self, frame: Any) -> np.ndarray | None:
        """Returns the body's pose (7,); None if it is not in a frame or not tracked."""
        for body in frame.rigid_bodies:
            if body.id_num == self._body:
                pose = pose_from_optitrack(np.array(body.pos), np.array(body.rot))
                is_unit = abs(np.linalg.norm(pose[3:]) - 1.0) < 0.01
                return pose if body.tracking_valid and is_unit and np.isfinite(pose).all() else None
        return None
