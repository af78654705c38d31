"""MotionCaptureReceiver: where OptiTrack sees the vehicle."""

import math
import weakref
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from splatpilot.systems.extras import import_extra
from splatpilot.systems.messaging.received import Received
from splatpilot.systems.messaging.udp_inbox import UdpConfig, UdpInbox
from splatpilot.systems.ports import output_port
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

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.udp.validate("motion_capture.udp")
        if len(self.version) != 2 or not [2, 6] <= self.version <= [4, 99]:
            raise ValueError(
                f"motion_capture.version is {self.version}; it must be two numbers from [2, 6] on, "
                "as [4, 1]"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seen(Received):
    pose: np.ndarray = field(default_factory=lambda: np.full(7, math.nan))
    time: float = -math.inf  # [s], of the last sight.


class MotionCaptureReceiver(LeafSystem):
    """Gives the pose of a rigid body in OptiTrack's stream, in our frames.

    .. pydrake_system::

        name: MotionCaptureReceiver
        output_ports:
        - motion_capture_pose
        - age
        - rejected

    - ``motion_capture_pose`` (7): p_WB [m] and q_WB (wxyz); NaN while the body is not seen.
    - ``age`` (1): [s] since it was seen; infinity before.
    - ``rejected`` (1): packets that were no frames, or of others than the senders that are named.

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update. The packets
    are read by the package `natnet`, extra `mocap`.

    Raises:
        ModuleNotFoundError: from the constructor where `natnet` is not installed.
        OSError: from the constructor where the packets cannot be received.
    """

    motion_capture_pose_output_port = output_port("motion_capture_pose")
    age_output_port = output_port("age")
    rejected_output_port = output_port("rejected")

    def __init__(self, config: MotionCaptureConfig, period: float):
        super().__init__()
        config.validate()
        natnet: Any = import_extra("natnet", "mocap")
        self._body, self._version = config.body_id, natnet.Version(*config.version)
        self._natnet, self._inbox = natnet, UdpInbox(config.udp)
        weakref.finalize(self, self._inbox.close)
        state = self.DeclareAbstractState(Value(_Seen()))
        ticket = {self.abstract_state_ticket(state)}
        pose = _Seen.output(lambda seen, _: seen.pose)
        age = _Seen.output(lambda seen, now: now - seen.time)
        rejected = _Seen.output(lambda seen, _: seen.rejected)
        self.DeclareVectorOutputPort("motion_capture_pose", 7, pose, ticket)
        self.DeclareVectorOutputPort("age", 1, age)
        self.DeclareVectorOutputPort("rejected", 1, rejected, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    @property
    def port(self) -> int:
        """The UDP port that the stream comes to."""
        return self._inbox.port

    def _take(self, context: Context, state: State) -> None:
        def after(seen: _Seen, packet: bytes) -> _Seen:
            try:
                pose = self._pose(packet)
            except Exception as error:  # natnet raises whatever comes of bytes that are no frame.
                raise ValueError(f"it is no frame of data ({error})") from None
            if pose is None:
                return seen
            time = context.get_time() if np.isfinite(pose).all() else seen.time
            return replace(seen, pose=pose, time=time)

        seen = _Seen.of(context).taking(*self._inbox.receive(), "motion capture", after)
        seen.keep(state)

    def _pose(self, packet: bytes) -> np.ndarray | None:
        """The body's pose (7,), NaN where it is not seen; None of other messages and bodies."""
        buffer = self._natnet.PacketBuffer(packet)
        kind, size = buffer.read_uint16(), buffer.read_uint16()
        if size != len(packet) - 4:
            raise ValueError(f"it has {len(packet)} bytes and says {size + 4}")
        if kind != _FRAME_OF_DATA:
            return None
        frame = self._natnet.DataFrame.read_from_buffer(buffer, self._version)
        for body in frame.rigid_bodies:
            if body.id_num == self._body:
                q = np.array(body.rot)
                if not body.tracking_valid or not abs(np.linalg.norm(q) - 1.0) < 0.01:
                    return np.full(7, math.nan)
                return np.append(from_optitrack(np.array(body.pos)), attitude_from_optitrack(q))
        return None
