"""Px4Telemetry: what PX4 says of itself."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.messaging.bridge_status import time_of_reading
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET, RESTART, Received
from splatpilot.systems.messaging.tof_receiver import UdpInbox
from splatpilot.systems.px4.mavlink import (
    ARM,
    OFFBOARD,
    SET_MODE,
    Attitude,
    Granted,
    Heartbeat,
    Mavlink,
    Message,
    Position,
    Timesync,
)
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import QuadrotorState, predict_state

HEARTBEAT_TIMEOUT = 3.0
"""[s] without a heartbeat, of which PX4 sends one a second, after which its mode is unknown."""

_QUESTION_PERIOD = 1.0  # [s] between our questions what time it is.
_MAX_DRIFT = 1e-4  # [s/s] between two clocks with crystals.


class _Offset(NamedTuple):
    """Bounds of the Unix time [s] at which PX4's clock was 0, and when they held."""

    latest: float = math.inf
    earliest: float = -math.inf
    time: float = 0.0

    def heard(self, sent: float, now: float) -> Self:
        """Returns the bounds after something came `now` [s] that PX4 sent at `sent` [s]."""
        drift = _MAX_DRIFT * (now - self.time)
        return self._replace(
            latest=min(self.latest + drift, now - sent), earliest=self.earliest - drift, time=now
        )

    def answered(self, asked: float, answer: float) -> Self:
        """Returns the bounds after PX4 answered with `answer` [s] what was asked at `asked` [s]."""
        return self._replace(earliest=max(self.earliest, asked - answer))

    @property
    def estimate(self) -> float:
        """Returns the middle of the bounds [s], as if messages took as long there as back."""
        earliest = min(self.earliest, self.latest)
        return self.latest if math.isinf(earliest) else 0.5 * (earliest + self.latest)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Said(Received):
    """What has come, and the Unix time [s] of each."""

    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat(False, (0, 0)))
    heard: float = -math.inf  # [s] of the Context.
    granted: frozenset[int] = frozenset()
    offset: _Offset = field(default_factory=_Offset)
    position: Position | None = None
    position_time: float = -math.inf
    attitude: Attitude | None = None
    attitude_time: float = -math.inf
    came: float = -math.inf  # [s], when either came last.
    question: int = 0  # [ns] PX4's last, and
    asked: float = -math.inf  # [s] of the Context, when it came.

    def after(self, message: Message, now: float, unix_time: float) -> Self:
        """Returns what is known after a message came `now` [s] in the Context, at `unix_time` [s].

        Raises:
            ValueError: if it is no newer than the one before.
        """
        if isinstance(message, Heartbeat):
            return replace(self, heartbeat=message, heard=now)
        if isinstance(message, Granted):
            return replace(self, granted=self.granted | {message.command})
        if isinstance(message, Timesync):
            return self._after_timesync(message, now, unix_time)
        last = self.position if isinstance(message, Position) else self.attitude
        said = self
        if last is not None and message.time <= last.time:
            has_restarted = message.time < last.time - RESTART and unix_time - self.came > RESTART
            if not has_restarted:
                raise ValueError(
                    f"{type(message).__name__.lower()} must be newer than {last.time:.3f} s after "
                    f"PX4 began, got {message.time:.3f} s"
                )
            said = replace(self, offset=_Offset(), position=None, attitude=None)
        offset = said.offset.heard(message.time, unix_time)
        said = replace(said, offset=offset, came=unix_time)
        measured = message.time + offset.estimate
        if isinstance(message, Position):
            return replace(said, position=message, position_time=measured)
        return replace(said, attitude=message, attitude_time=measured)

    def _after_timesync(self, message: Timesync, now: float, unix_time: float) -> Self:
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
        """Returns the Unix time [s] of the state: that of the older of position and attitude."""
        is_whole = self.position is not None and self.attitude is not None
        return min(self.position_time, self.attitude_time) if is_whole else -math.inf

    @property
    def state(self) -> np.ndarray:
        """Returns the state (13,) at that time."""
        p, a = self.position, self.attitude
        if p is None or a is None:
            return hover_state(np.zeros(3))
        state = QuadrotorState(p.p_WB, p.v_WB, a.q_WB, a.w_WB_B).to_vector()
        time = min(p.time, a.time)
        p_WB, v_WB, _, _ = QuadrotorState.of(predict_state(state, time - p.time))
        _, _, q_WB, w_WB_B = QuadrotorState.of(predict_state(state, time - a.time))
        return QuadrotorState(p_WB, v_WB, q_WB, w_WB_B).to_vector()


class Px4Telemetry(LeafSystem):
    """Gives the state that PX4 estimates, how old it is, and whether the vehicle is armed and flies
    by our setpoints.

    .. pydrake_system::

        name: Px4Telemetry
        input_ports:
        - unix_time
        output_ports:
        - state
        - age
        - heartbeat_age
        - armed
        - mode
        - granted
        - vehicle_status
        - rejected

    - ``unix_time`` (1): [s].
    - ``state`` (13): p_WB [m], v_WB [m/s], q_WB (wxyz), w_WB_B [rad/s], of LOCAL_POSITION_NED and
      ATTITUDE_QUATERNION; at rest in the origin before both have come. It is the state at the time
      of the older of the two, to which the other is brought back by its velocity or its rates.
    - ``age`` (1): [s] since then; infinity before both have come.
    - ``heartbeat_age`` (1): [s] since the last HEARTBEAT; infinity before the first.
    - ``armed`` (1), ``mode`` (2): of that; main and sub mode. 0 where it is older than 3 s.
    - ``vehicle_status`` (2): whether it is armed, and whether it is in offboard mode; NaN where the
      last HEARTBEAT is older than 3 s. See ``lcmt_vehicle_status``.
    - ``granted`` (2): whether PX4 has ever accepted a command for a mode, and one to arm.
    - ``rejected`` (1): packets and messages that were not MAVLink, of others than the senders that
      are named, no newer than the message before, or with values that are not finite; the reason
      is logged at the first, second, fourth, eighth...

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update, asks PX4
    every second what time it is, and answers its own such questions (TIMESYNC).

    Ages are by PX4's own stamps, so that they tell what a link delays or buffers. The Unix time at
    which PX4's clock was 0 is bounded by what came fastest from it and by its fastest answer::

        question - answer <= zero <= arrival - stamp

    It is taken to be in the middle. The bounds widen by 0.1 ms/s, for clocks that drift. PX4 has
    started again if its stamps go back by more than a second after a second of silence.
    """

    unix_time_input_port = input_port("unix_time")
    state_output_port = output_port("state")
    age_output_port = output_port("age")
    heartbeat_age_output_port = output_port("heartbeat_age")
    armed_output_port = output_port("armed")
    mode_output_port = output_port("mode")
    granted_output_port = output_port("granted")
    vehicle_status_output_port = output_port("vehicle_status")
    rejected_output_port = output_port("rejected")

    def __init__(
        self,
        inbox: UdpInbox,
        mavlink: Mavlink,
        address: tuple[str, int],
        period: float,
        now: Callable[[], float] | None = None,
    ):
        """Constructs the system.

        Args:
            inbox: what comes, and whose socket is sent from.
            mavlink: that reads and writes the messages.
            address: host and port of PX4.
            period: [s] between looks at what has come.
            now: tells the Unix time [s] in a process that runs with the wall clock.
        """
        super().__init__()
        self._inbox, self._mavlink, self._address = inbox, mavlink, address
        self._now = now
        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareAbstractState(Value(_Said()))
        self.DeclareVectorOutputPort("age", 1, self._calc_age)
        outputs: dict[str, tuple[int, Callable[[_Said, float], Any]]] = {
            "state": (13, lambda said, now: said.state),
            "heartbeat_age": (1, lambda said, now: now - said.heard),
            "armed": (1, lambda said, now: _is_known(said, now) and said.heartbeat.armed),
            "mode": (2, lambda said, now: _is_known(said, now) * np.array(said.heartbeat.mode)),
            "granted": (2, lambda said, now: [SET_MODE in said.granted, ARM in said.granted]),
            "vehicle_status": (2, _vehicle_status),
            "rejected": (1, lambda said, now: said.rejected),
        }
        for name, (size, value) in outputs.items():
            self.DeclareVectorOutputPort(name, size, _Said.output(value))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._answer)
        self.DeclarePeriodicPublishEvent(_QUESTION_PERIOD, PUBLISH_OFFSET, self._ask)

    def _take(self, context: Context, state: State) -> None:
        datagrams = self._inbox.receive()
        now, unix_time = context.get_time(), time_of_reading(self, context, self._now)

        def after(said: _Said, packet: bytes) -> _Said:
            messages, refused = self._mavlink.read(packet)
            for message in messages:
                try:
                    said = said.after(message, now, unix_time)
                except ValueError as error:
                    refused.append(str(error))
            for why in refused:
                said = said.rejecting(1, "PX4", why)
            return said

        _Said.of(context).taking(*datagrams, "PX4", after).keep(state)

    def _ask(self, context: Context) -> None:
        self._send(context, lambda now: Timesync(0, now))

    def _answer(self, context: Context) -> None:
        said = _Said.of(context)
        if context.get_time() - said.asked < 2.0 * PUBLISH_OFFSET:
            self._send(context, lambda now: Timesync(now, said.question))

    def _send(self, context: Context, timesync: Callable[[int], Timesync]) -> None:
        message = timesync(round(1e9 * time_of_reading(self, context, self._now)))
        self._inbox.send(self._mavlink.timesync(message), self._address)

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        unix_time = float(np.asarray(self.GetInputPort("unix_time").Eval(context))[0])
        output[0] = unix_time - _Said.of(context).measured


def _is_known(said: _Said, now: float) -> bool:
    return now - said.heard <= HEARTBEAT_TIMEOUT


def _vehicle_status(said: _Said, now: float) -> list[float]:
    if not _is_known(said, now):
        return [math.nan, math.nan]
    return [said.heartbeat.armed, said.heartbeat.mode[0] == OFFBOARD[0]]
