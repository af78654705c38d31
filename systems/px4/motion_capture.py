"""MotionCaptureReceiver: where OptiTrack sees the vehicle."""

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.messaging.bridge_status import time_of_reading
from splatpilot.systems.messaging.lcm_ports import RESTART, Received
from splatpilot.systems.messaging.tof_receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.frames import attitude_from_optitrack, from_optitrack

_FRAME_OF_DATA = 7  # NatNet's number of the messages that carry poses.


@dataclass
class MotionCaptureConfig:
    """OptiTrack's stream, which Motive sends to a multicast group."""

    udp: UdpConfig = field(default_factory=lambda: UdpConfig(port=1511, group="239.255.42.99"))
    # Streaming ID of the vehicle's rigid body.
    body_id: int = 1
    # Version of the protocol, as Motive's settings for streaming have it.
    version: list[int] = field(default_factory=lambda: [4, 1])
    # [s] How old a frame is when it comes: from the exposure on.
    latency: float = 0.01

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.udp.validate("motion_capture.udp")
        if len(self.version) != 2 or not [2, 6] <= self.version <= [4, 99]:
            raise ValueError(
                f"motion_capture.version is {self.version}; it must be two numbers from [2, 6] on, "
                "as [4, 1]"
            )
        if not 0.0 <= self.latency <= 1.0:
            raise ValueError(f"motion_capture.latency must be in [0, 1] s, got {self.latency:g}")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seen(Received):
    pose: np.ndarray = field(default_factory=lambda: np.full(7, math.nan))
    time: float = -math.inf  # [s] Unix time of the last exposure that shows the body.
    number: int = -1  # Of the newest frame.
    came: float = -math.inf  # [s] Unix time, when that came.

    def after(self, number: int, pose: np.ndarray | None, now: float, latency: float) -> Self:
        """Returns what is known after a frame came.

        Args:
            number: of the frame.
            pose: (7,), or None if the frame does not show the body.
            now: [s] Unix time.
            latency: [s] from the exposure until a frame comes.

        Raises:
            ValueError: if the frame is no newer than the one before.
        """
        if number <= self.number and now - self.came <= RESTART:
            raise ValueError(f"frame must be newer than {self.number}, got {number}")
        seen = replace(self, number=number, came=now)
        return seen if pose is None else replace(seen, pose=pose, time=now - latency)


class MotionCaptureReceiver(LeafSystem):
    """Gives the pose of a rigid body in OptiTrack's stream, in our frames.

    .. pydrake_system::

        name: MotionCaptureReceiver
        input_ports:
        - unix_time
        output_ports:
        - motion_capture_pose
        - age
        - rejected

    - ``unix_time`` (1): [s].
    - ``motion_capture_pose`` (7): p_WB [m] and q_WB (wxyz), where the body was seen last; NaN
      before.
    - ``age`` (1): [s] since it was seen there: since the frame came, and its latency; infinity
      before. It grows while frames do not come, do not hold the body or do not track it.
    - ``rejected`` (1): packets that were not frames, no newer than the frame before, or of others
      than the senders that are named. A stream that was silent for a second may start again.

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update. The packets
    are read by the package `natnet`, extra `mocap`.

    """

    unix_time_input_port = input_port("unix_time")
    motion_capture_pose_output_port = output_port("motion_capture_pose")
    age_output_port = output_port("age")
    rejected_output_port = output_port("rejected")

    def __init__(
        self, config: MotionCaptureConfig, period: float, now: Callable[[], float] | None = None
    ):
        """Constructs the system.

        Args:
            config: where the stream comes to.
            period: [s] between looks at what has come.
            now: tells the Unix time [s] in a process that runs with the wall clock.

        Raises:
            ModuleNotFoundError: if `natnet` is not installed.
            OSError: if the packets cannot be received.
        """
        super().__init__()
        config.validate()
        natnet: Any = import_extra("natnet", "mocap")
        self._body, self._version = config.body_id, natnet.Version(*config.version)
        self._natnet, self._inbox = natnet, UdpInbox(config.udp)
        weakref.finalize(self, self._inbox.close)
        self._latency, self._now = config.latency, now
        self.DeclareVectorInputPort("unix_time", 1)
        state = self.DeclareAbstractState(Value(_Seen()))
        ticket = {self.abstract_state_ticket(state)}
        pose = _Seen.output(lambda seen, _: seen.pose)
        rejected = _Seen.output(lambda seen, _: seen.rejected)
        self.DeclareVectorOutputPort("motion_capture_pose", 7, pose, ticket)
        self.DeclareVectorOutputPort("age", 1, self._calc_age)
        self.DeclareVectorOutputPort("rejected", 1, rejected, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    @property
    def port(self) -> int:
        """The UDP port that the stream comes to."""
        return self._inbox.port

    def _take(self, context: Context, state: State) -> None:
        datagrams, now = self._inbox.receive(), time_of_reading(self, context, self._now)

        def after(seen: _Seen, packet: bytes) -> _Seen:
            try:
                frame = self._frame(packet)
                pose = None if frame is None else self._pose(frame)
            except Exception as error:  # natnet raises whatever comes of bytes that are no frame.
                raise ValueError(f"it is no frame of data ({error})") from None
            if frame is None:
                return seen
            return seen.after(frame.prefix.frame_number, pose, now, self._latency)

        _Seen.of(context).taking(*datagrams, "motion capture", after).keep(state)

    def _frame(self, packet: bytes) -> Any:
        """Reads a frame of data; None of messages of other kinds."""
        buffer = self._natnet.PacketBuffer(packet)
        kind, size = buffer.read_uint16(), buffer.read_uint16()
        if size != len(packet) - 4:
            raise ValueError(f"it has {len(packet)} bytes and says {size + 4}")
        if kind != _FRAME_OF_DATA:
            return None
        return self._natnet.DataFrame.read_from_buffer(buffer, self._version)

    def _pose(self, frame: Any) -> np.ndarray | None:
        """Returns the body's pose (7,); None where it is not in a frame or not tracked."""
        for body in frame.rigid_bodies:
            if body.id_num == self._body:
                q = np.array(body.rot)
                pose = np.append(from_optitrack(np.array(body.pos)), attitude_from_optitrack(q))
                is_unit = abs(np.linalg.norm(q) - 1.0) < 0.01
                return pose if body.tracking_valid and is_unit and np.isfinite(pose).all() else None
        return None

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        unix_time = float(np.asarray(self.GetInputPort("unix_time").Eval(context))[0])
        output[0] = unix_time - _Seen.of(context).time
