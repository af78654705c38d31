"""Px4Telemetry: what PX4 says of itself."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.messaging.udp_inbox import UdpInbox
from splatpilot.systems.ports import output_port
from splatpilot.systems.px4.mavlink import Attitude, Heartbeat, Mavlink, Position
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Said:
    """What has come, and when [s]. Nothing in it changes: Contexts may share it."""

    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat(False, (0, 0)))
    heard: float = -math.inf
    position: Position | None = None
    placed: float = -math.inf
    attitude: Attitude | None = None
    turned: float = -math.inf
    rejected: int = 0

    def __deepcopy__(self, memo: dict) -> "_Said":
        return self


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
        - rejected

    - ``state`` (13): p_WB [m], v_WB [m/s], q_WB (wxyz), w_WB_B [rad/s], of LOCAL_POSITION_NED and
      ATTITUDE_QUATERNION; at rest in the origin before both have come.
    - ``age`` (1): [s] since the older of the two came; infinity before. ``is_fresh`` (1): whether
      that is at most ``max_age``.
    - ``heartbeat_age`` (1), ``armed`` (1), ``mode`` (2): of the last HEARTBEAT; main and sub mode.
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
            "rejected": (1, lambda said, now: said.rejected),
        }
        for name, (size, value) in outputs.items():
            self.DeclareVectorOutputPort(name, size, _calc(value))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    def _take(self, context: Context, state: State) -> None:
        said, now = _said(context), context.get_time()
        packets, strangers = self._inbox.receive()
        if strangers:
            said = _refused(said, strangers, "its sender is not named")
        for packet in packets:
            try:
                messages = self._mavlink.read(packet)
            except ValueError as error:
                said = _refused(said, 1, str(error))
                continue
            for message in messages:
                if isinstance(message, Heartbeat):
                    said = replace(said, heartbeat=message, heard=now)
                elif isinstance(message, Position):
                    said = replace(said, position=message, placed=now)
                else:
                    said = replace(said, attitude=message, turned=now)
        state.get_mutable_abstract_state(0).set_value(said)


def _calc(value: Callable[[_Said, float], Any]) -> Callable[[Context, BasicVector], None]:
    def calc(context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.atleast_1d(value(_said(context), context.get_time())).astype(float))

    return calc


def _state(said: _Said) -> np.ndarray:
    if said.position is None or said.attitude is None:
        return hover_state(np.zeros(3))
    return QuadrotorState(*said.position, *said.attitude).to_vector()


def _refused(said: _Said, count: int, why: str) -> _Said:
    total = said.rejected + count
    if total.bit_length() != said.rejected.bit_length():
        _log.warning("PX4: a packet is refused, %d so far: %s", total, why)
    return replace(said, rejected=total)


def _said(context: Context) -> _Said:
    return cast(_Said, context.get_abstract_state(0).get_value())
