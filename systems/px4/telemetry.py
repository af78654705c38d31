"""Px4Telemetry: receives PX4's state and mode."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from pydrake.systems.framework import Context

from splatpilot.systems.common.validation import require
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET
from splatpilot.systems.messaging.receiver import RESTART, Inbox, Received, Receiver
from splatpilot.systems.px4 import mavlink
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, predict_state

_log = logging.getLogger(__name__)

HEARTBEAT_TIMEOUT = 3.0
"""[s] without a heartbeat, which PX4 sends every second, after which its mode is unknown."""

_QUESTION_PERIOD = 1.0  # [s] between our requests for PX4's time.
_MAX_DRIFT = 1e-4  # [s/s] between two clocks with crystals.


class _Offset(NamedTuple):
    """Bounds of the Unix time [s] at which PX4's clock was 0."""

    latest: float = math.inf
    earliest: float = -math.inf
    time: float = 0.0  # [s] Unix time for which the bounds hold.

    def heard(self, sent: float, now: float) -> Self:
        """Returns the bounds after a message arrived `now` [s] that PX4 sent at `sent` [s]."""
        drift = _MAX_DRIFT * (now - self.time)
        latest = min(self.latest + drift, now - sent)
        return self._replace(latest=latest, earliest=self.earliest - drift, time=now)

    def answered(self, question: float, answer: float) -> Self:
        """Returns the bounds after PX4 answered at `answer` [s] a question of `question` [s]."""
        return self._replace(earliest=max(self.earliest, question - answer))

    @property
    def estimate(self) -> float:
        """The middle of the bounds [s], as if messages took as long in both directions."""
        earliest = min(self.earliest, self.latest)
        return self.latest if math.isinf(earliest) else 0.5 * (earliest + self.latest)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Telemetry(Received):
    heartbeat: mavlink.Heartbeat = field(default_factory=lambda: mavlink.Heartbeat(False, (0, 0)))
    heard: float = -math.inf  # [s] of the Context, of the heartbeat.
    granted: frozenset[int] = frozenset()  # accepted commands.
    notice: str = ""  # the last warning or refusal.
    offset: _Offset = field(default_factory=_Offset)
    position: mavlink.Position | None = None
    position_time: float = -math.inf  # [s] Unix time.
    attitude: mavlink.Attitude | None = None
    attitude_time: float = -math.inf  # [s] Unix time.
    came: float = -math.inf  # [s] Unix time of the last position or attitude.
    question: int = 0  # [ns] PX4's last time request, and
    asked: float = -math.inf  # [s] of the Context, of its arrival.

    def after(self, message: mavlink.Message, now: float, unix_time: float) -> Self:
        """Returns the state after a message came `now` [s] in the Context, at `unix_time` [s];
        raises ValueError if it is no newer than the one before."""
        if isinstance(message, mavlink.Heartbeat):
            return replace(self, heartbeat=message, heard=now)
        if isinstance(message, mavlink.Granted):
            return replace(self, granted=self.granted | {message.command}, notice="")
        if isinstance(message, mavlink.Notice):
            if message.text != self.notice:
                _log.warning("PX4: %s", message.text)
            return replace(self, notice=message.text)
        if isinstance(message, mavlink.Timesync):
            return self._after_timesync(message, now, unix_time)
        last = self.position if isinstance(message, mavlink.Position) else self.attitude
        received = self
        if last is not None and message.time <= last.time:
            has_restarted = message.time < last.time - RESTART and unix_time - self.came > RESTART
            condition = f"newer than {last.time:.3f} s after PX4 began"
            what, time = type(message).__name__.lower(), f"{message.time:.3f} s"
            require(has_restarted, what, condition, time)
            received = replace(self, offset=_Offset(), position=None, attitude=None)
        offset = received.offset.heard(message.time, unix_time)
        received = replace(received, offset=offset, came=unix_time)
        measured = message.time + offset.estimate
        if isinstance(message, mavlink.Position):
            return replace(received, position=message, position_time=measured)
        return replace(received, attitude=message, attitude_time=measured)

    def _after_timesync(self, message: mavlink.Timesync, now: float, unix_time: float) -> Self:
        answer, question = 1e-9 * message.answer, 1e-9 * message.question
        if message.answer == 0:
            offset = self.offset.heard(question, unix_time)
            return replace(self, offset=offset, question=message.question, asked=now)
        offset = self.offset.heard(answer, unix_time)
        if 0.0 <= unix_time - question <= _QUESTION_PERIOD:  # Others may ask too.
            offset = offset.answered(question, answer)
        return replace(self, offset=offset)

    @property
    def measured(self) -> float:
        """Unix time [s] of the state: that of the older of position and attitude."""
        is_complete = self.position is not None and self.attitude is not None
        return min(self.position_time, self.attitude_time) if is_complete else -math.inf

    @property
    def state(self) -> np.ndarray:
        """The state (13,) at that time."""
        p, a = self.position, self.attitude
        if p is None or a is None:
            return hover_state(np.zeros(3))
        state = QuadrotorState(p.p_WB, p.v_WB, a.q_WB, a.w_WB_B).to_vector()
        time = min(p.time, a.time)
        moved, rotated = (predict_state(state, time - each.time) for each in (p, a))
        return np.append(moved[:6], rotated[6:])

    def mode(self, now: float) -> tuple[float, ...]:
        """Returns if PX4 is armed, its mode, and the signal of `VehicleStatusCodec`; zeros and NaN
        if they are unknown at `now` [s]."""
        (armed, mode), is_known = self.heartbeat, now - self.heard <= HEARTBEAT_TIMEOUT
        known = armed, *mode, armed, mode[0] == mavlink.OFFBOARD[0]
        return known if is_known else (0, 0, 0, math.nan, math.nan)


class Px4Telemetry(Receiver[_Telemetry]):
    """Outputs the state that PX4 estimates, its age, and PX4's mode.

    .. pydrake_system::

        name: Px4Telemetry
        input_ports: [unix_time]
        output_ports: [state, age, heartbeat_age, armed, mode, granted, vehicle_status, rejected]

    - ``state`` (13), ``age`` (1) [s]: of LOCAL_POSITION_NED and ATTITUDE_QUATERNION, at the time of
      the older. At rest in the origin, and infinite, before both have come.
    - ``heartbeat_age`` (1): [s] since the last HEARTBEAT; infinity before the first.
    - ``armed`` (1), ``mode`` (2): of that; main and sub mode. 0 if it is older than 3 s.
    - ``vehicle_status`` (2): see ``lcmt_vehicle_status``; NaN if the heartbeat is older than 3 s.
    - ``granted`` (2): 1 if PX4 has ever accepted a command for a mode, and one to arm.
    - ``rejected`` (1): number of packets and messages that were not MAVLink, not finite, of other
      senders, or no newer than the one before.

    Ages are by PX4's own stamps, to include the delay of the link. The Unix time at which PX4's
    clock was 0 is the middle between bounds, by its fastest message and its fastest answer to
    TIMESYNC, which widen by 0.1 ms/s, for clocks that drift::

        question - answer <= zero <= arrival - stamp

    PX4 has restarted if its stamps go back by more than a second after a second of silence.
    """

    def __init__(
        self,
        inbox: Inbox,
        link: mavlink.Mavlink,
        address: tuple[str, int],
        period: float,
        now: Callable[[], float] | None = None,
    ):
        super().__init__(_Telemetry(), "PX4", period, now)
        self._inbox, self._link, self._address = inbox, link, address
        self._declare_age(lambda received: received.measured)
        self._declare("state", 13, lambda received, _: received.state)
        commands = mavlink.SET_MODE, mavlink.ARM
        self._declare("granted", 2, lambda got, _: [each in got.granted for each in commands])
        self._declare("heartbeat_age", 1, lambda got, now: now - got.heard, timed=True)
        self._declare("armed", 1, lambda got, now: got.mode(now)[0], timed=True)
        self._declare("mode", 2, lambda got, now: got.mode(now)[1:3], timed=True)
        self._declare("vehicle_status", 2, lambda got, now: got.mode(now)[3:], timed=True)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._answer)
        self.DeclarePeriodicPublishEvent(_QUESTION_PERIOD, PUBLISH_OFFSET, self._ask)

    def _receive(self, context: Context, received: _Telemetry) -> _Telemetry:
        datagrams = self._inbox.receive()
        now, unix_time = context.get_time(), self._time_of_reading(context)

        def read(received: _Telemetry, packet: bytes) -> _Telemetry:
            messages, refused = self._link.read(packet)
            for message in messages:
                try:
                    received = received.after(message, now, unix_time)
                except ValueError as error:
                    refused.append(str(error))
            for reason in refused:
                received = self._reject(received, reason)
            return received

        return self._take(received, *datagrams, read)

    def _ask(self, context: Context) -> None:
        self._send(context, lambda now: mavlink.Timesync(0, now))

    def _answer(self, context: Context) -> None:
        received = self._received(context)
        if context.get_time() - received.asked < 2.0 * PUBLISH_OFFSET:
            self._send(context, lambda now: mavlink.Timesync(now, received.question))

    def _send(self, context: Context, timesync: Callable[[int], mavlink.Timesync]) -> None:
        message = timesync(round(1e9 * self._time_of_reading(context)))
        self._inbox.send(self._link.timesync(message), self._address)
