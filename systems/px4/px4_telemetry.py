"""Px4Telemetry: what PX4 says of itself."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from splatpilot.systems.messaging.received import Received
from splatpilot.systems.messaging.udp_inbox import UdpInbox
from splatpilot.systems.ports import output_port
from splatpilot.systems.px4.mavlink import OFFBOARD, Attitude, Heartbeat, Mavlink, Position
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

HEARTBEAT_TIMEOUT = 3.0
"""[s] since the last heartbeat after which it is unknown who flies: two of PX4's may be lost."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Said(Received):
    """What has come, and when [s]."""

    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat(False, (0, 0)))
    heard: float = -math.inf
    position: Position | None = None
    placed: float = -math.inf
    attitude: Attitude | None = None
    turned: float = -math.inf


class Px4Telemetry(LeafSystem):
    """Gives the state that PX4 estimates, how old it is, and whether the vehicle is armed and flies
    by our setpoints.

    .. pydrake_system::

        name: Px4Telemetry
        output_ports:
        - state
        - age
        - is_fresh
        - heartbeat_age
        - armed
        - mode
        - vehicle_status
        - rejected

    - ``state`` (13): p_WB [m], v_WB [m/s], q_WB (wxyz), w_WB_B [rad/s], of LOCAL_POSITION_NED and
      ATTITUDE_QUATERNION; at rest in the origin before both have come.
    - ``age`` (1): [s] since the older of the two came; infinity before. ``is_fresh`` (1): whether
      that is at most ``max_age``.
    - ``heartbeat_age`` (1), ``armed`` (1), ``mode`` (2): of the last HEARTBEAT; main and sub mode.
    - ``vehicle_status`` (2): whether it is armed, and whether it is in offboard mode; NaN if the
      last HEARTBEAT is older than 3 s. See ``lcmt_vehicle_status``.
    - ``rejected`` (1): packets that were no MAVLink, of others than the senders that are named, or
      with numbers that are none; the reason is logged at the first, second, fourth, eighth...

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update.
    """

    state_output_port = output_port("state")
    age_output_port = output_port("age")
    is_fresh_output_port = output_port("is_fresh")
    heartbeat_age_output_port = output_port("heartbeat_age")
    armed_output_port = output_port("armed")
    mode_output_port = output_port("mode")
    vehicle_status_output_port = output_port("vehicle_status")
    rejected_output_port = output_port("rejected")

    def __init__(self, inbox: UdpInbox, mavlink: Mavlink, period: float, max_age: float = 0.1):
        """Constructs the system; see the class."""
        super().__init__()
        self._inbox, self._mavlink = inbox, mavlink
        self.DeclareAbstractState(Value(_Said()))
        outputs: dict[str, tuple[int, Callable[[_Said, float], Any]]] = {
            "state": (13, lambda said, now: _state(said)),
            "age": (1, lambda said, now: now - min(said.placed, said.turned)),
            "is_fresh": (1, lambda said, now: now - min(said.placed, said.turned) <= max_age),
            "heartbeat_age": (1, lambda said, now: now - said.heard),
            "armed": (1, lambda said, now: said.heartbeat.armed),
            "mode": (2, lambda said, now: said.heartbeat.mode),
            "vehicle_status": (2, _vehicle_status),
            "rejected": (1, lambda said, now: said.rejected),
        }
        for name, (size, value) in outputs.items():
            self.DeclareVectorOutputPort(name, size, _Said.output(value))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    def _take(self, context: Context, state: State) -> None:
        now = context.get_time()

        def after(said: _Said, packet: bytes) -> _Said:
            for message in self._mavlink.read(packet):
                if isinstance(message, Heartbeat):
                    said = replace(said, heartbeat=message, heard=now)
                elif isinstance(message, Position):
                    said = replace(said, position=message, placed=now)
                else:
                    said = replace(said, attitude=message, turned=now)
            return said

        _Said.of(context).taking(*self._inbox.receive(), "PX4", after).keep(state)


def _vehicle_status(said: _Said, now: float) -> list[float]:
    if now - said.heard > HEARTBEAT_TIMEOUT:
        return [math.nan, math.nan]
    return [said.heartbeat.armed, said.heartbeat.mode[0] == OFFBOARD[0]]


def _state(said: _Said) -> np.ndarray:
    if said.position is None or said.attitude is None:
        return hover_state(np.zeros(3))
    return QuadrotorState(*said.position, *said.attitude).to_vector()
