"""LCM messages as ports: publishers, subscribers, their clock and status, and logs."""

import logging
import math
import os
import time
import weakref
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from drake import lcmt_header
from lcm import LCM, EventLog
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from splatpilot.systems.common.drake import optional_input, vector_input, weak_callback
from splatpilot.systems.common.files import require_unused
from splatpilot.systems.common.readers import require_file
from splatpilot.systems.common.validation import require
from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.receiver import RESTART, Received, Receiver


class BridgeStatus(LeafSystem):
    """Summarizes mode, ages of inputs, and lost messages of a bridge.

    .. pydrake_system::

        name: BridgeStatus
        input_ports: [state_age, state_gaps, state_rejected, (the same of each image), overruns,
            mode]
        output_ports: [status, observation_age]

    - ``s_age``, ``s_gaps``, ``s_rejected`` (1 each) of each input ``s``: see `MessageSubscriber`.
    - ``overruns`` (1), optional: number of ticks that ended too late. ``mode`` (2): see `Failsafe`.
    - ``status`` (7): mode and reason; ages of the state and of the oldest image [s]; sums of gaps
      and of rejected messages; overruns.
    - ``observation_age`` (1): of the oldest image [s], 0 without images.
    """

    def __init__(self, images: list[str]):
        super().__init__()
        self._inputs = ["state", *images]
        for name in self._inputs:
            for signal in ("age", "gaps", "rejected"):
                self.DeclareVectorInputPort(f"{name}_{signal}", 1)
        self.DeclareVectorInputPort("overruns", 1)
        self.DeclareVectorInputPort("mode", 2)
        self.DeclareVectorOutputPort("status", 7, self._calc_status)
        tickets = {self.GetInputPort(f"{image}_age").ticket() for image in images}
        tickets = tickets or {self.nothing_ticket()}
        self.DeclareVectorOutputPort("observation_age", 1, self._calc_observation_age, tickets)

    def _read(self, context: Context, signal: str, first: int = 0) -> list[float]:
        names = [f"{name}_{signal}" for name in self._inputs[first:]]
        return [vector_input(self, name, context)[0] for name in names]

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        mode, ages = vector_input(self, "mode", context), self._read(context, "age")
        overruns = optional_input(self, "overruns", context)
        overruns = 0.0 if overruns is None else overruns[0]
        gaps, rejected = (sum(self._read(context, signal)) for signal in ("gaps", "rejected"))
        oldest = max(ages[1:], default=0.0)
        output.SetFromVector(np.array([*mode, ages[0], oldest, gaps, rejected, overruns]))

    def _calc_observation_age(self, context: Context, output: BasicVector) -> None:
        output[0] = max(self._read(context, "age", first=1), default=0.0)


class UnixClock(LeafSystem):
    """Outputs ``unix_time`` (1) [s], which stamps messages: the epoch, numeric parameter 0, plus
    the Context's time."""

    def __init__(self):
        super().__init__()
        self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self.DeclareVectorOutputPort("unix_time", 1, self._calc)

    def set_epoch(self, root: Context, epoch: float) -> None:
        """Sets the Unix time [s] of the time 0 of a root Context."""
        context = self.GetMyMutableContextFromRoot(root)
        context.get_mutable_numeric_parameter(0).SetFromVector(np.array([epoch]))

    def _calc(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_numeric_parameter(0)[0] + context.get_time()


DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4000000"
"""LCM's own group and port, limited to this host (ttl=0); a buffer for images."""

PUBLISH_OFFSET = 1e-6
"""[s] from the updates of an instant to publishing their results: publish events of the same
instant would see the state before the updates."""

SAME_TIME = 1e-4  # [s] Max difference of equal times of measurement, computed from ages.
MAX_AHEAD = 0.2  # [s] Max lead of a sender's clock; ours is behind while the process is busy.
_PROBE = "SPLATPILOT_PROBE"
_QUEUE = 1000  # Max number of waiting messages. LCM's 30 are half a second of states.

# LCM waits by select(), which overwrites its stack for files numbered from 1024; it opens several.
_MAX_FILES = 1000

_log = logging.getLogger(__name__)


def open_lcm(url: str = DEFAULT_URL) -> LCM:
    """Opens LCM at `udpm://GROUP:PORT?ttl=HOPS` or, within this process, `memq://`; raises OSError
    unless it delivers."""
    if not url.startswith(("udpm://", "memq://")):
        raise OSError(f"the LCM URL must begin with udpm:// or memq://, got {url!r}")
    with open(os.devnull) as file:
        number = file.fileno()
    if number >= _MAX_FILES:
        limit = f"at most {_MAX_FILES} files may be open in this process, got {number}; close some"
        raise OSError(f"LCM cannot use {url}: {limit}")
    remedy = (
        "use a multicast group and a port that only LCM has, and give the host a multicast route "
        "(ip route add 224.0.0.0/4 dev lo)"
    )
    heard, deadline = [], time.monotonic() + 2.0
    try:
        lcm = LCM(url)
        probe = lcm.subscribe(_PROBE, lambda _, data: heard.append(data))
        # LCM returns no subscription without a port, and prints the reason.
        while probe is not None and not heard and time.monotonic() < deadline:
            lcm.publish(_PROBE, b"")
            lcm.handle_timeout(100)
    except (RuntimeError, OSError) as error:
        raise OSError(f"LCM cannot use {url}: {error}; {remedy}") from None
    if probe is None or not heard:
        raise OSError(f"LCM at {url} does not deliver its own messages; {remedy}")
    lcm.unsubscribe(probe)
    return lcm


class _Publisher(LeafSystem):
    """Base of publishers: input 0 is the signal, 1 is `unix_time`, the others are scalars."""

    def __init__(self, lcm: LCM, codec: Codec, *inputs: str):
        super().__init__()
        self._lcm, self._codec = lcm, codec
        if codec.image is None:
            self.DeclareVectorInputPort(codec.port, codec.size)
        else:
            self.DeclareAbstractInputPort(codec.port, Value(codec.image))
        for name in ("unix_time", *inputs):
            self.DeclareVectorInputPort(name, 1)

    def _send(self, context: Context, seq: int, stamp: float | None = None) -> None:
        """Sends the signal with a number and a Unix time [s], the current one if None."""
        unix_time = float(vector_input(self, "unix_time", context)[0])
        header = lcmt_header()
        header.seq, header.frame_name = seq, self._codec.frame
        header.utime = round((unix_time if stamp is None else stamp) * 1e6)
        value: Any = self.get_input_port(0).Eval(context)
        array = np.asarray(value if self._codec.image is None else value.data)
        message = self._codec.pack(array, header, unix_time - context.get_time())
        if message is not None:
            self._lcm.publish(self._codec.channel, message.encode())


class MessagePublisher(_Publisher):
    """Sends a signal periodically.

    .. pydrake_system::

        name: MessagePublisher
        input_ports: [(port of the codec), unix_time, enabled, decided]

    - ``unix_time`` (1): [s], see `UnixClock`.
    - ``enabled`` (1), optional: 0 sends no messages.
    - ``decided`` (1), optional: [s], when the signal was computed last. With a ``tick`` [s], it is
      sent then too, between two periods.

    Publishes every ``period`` [s] from time 0, and when forced. The sequence number is the time in
    whole periods: subscribers count messages that were not sent as missing.
    """

    def __init__(self, lcm: LCM, codec: Codec, period: float, tick: float | None = None):
        super().__init__(lcm, codec, "enabled", "decided")
        self._period = period
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)
        if tick is not None:
            self.DeclarePeriodicPublishEvent(tick, PUBLISH_OFFSET, self._publish_decided)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish_decided(self, context: Context) -> None:
        decided = optional_input(self, "decided", context)
        now = context.get_time() - PUBLISH_OFFSET
        is_due = abs(math.remainder(now, self._period)) < PUBLISH_OFFSET  # `_publish` sends it.
        if decided is not None and now - decided[0] < PUBLISH_OFFSET and not is_due:
            self._publish(context)

    def _publish(self, context: Context) -> None:
        enabled = optional_input(self, "enabled", context)
        if enabled is None or enabled[0]:
            self._send(context, math.floor(context.get_time() / self._period + 1e-6))


class _Sent(NamedTuple):
    """The discrete state of a `MeasurementPublisher`."""

    measured: float = -math.inf  # [s] Unix time of the last measurement.
    seq: float = -1.0  # of its message.
    came: float = -math.inf  # [s] of its arrival.

    @classmethod
    def read(cls, context: Context) -> "_Sent":
        return cls(*np.asarray(context.get_discrete_state_vector().value()))


class MeasurementPublisher(_Publisher):
    """Sends each measurement once, when it comes.

    .. pydrake_system::

        name: MeasurementPublisher
        input_ports: [(port of the codec), age, unix_time]

    - ``age`` (1): [s] since the measurement; infinite before the first.
    - ``unix_time`` (1): [s], see `UnixClock`.

    Looks every ``period`` [s] from time 0. Messages have the time of the measurement.
    """

    def __init__(self, lcm: LCM, codec: Codec, period: float):
        super().__init__(lcm, codec, "age")
        self.DeclareDiscreteState(np.array(_Sent()))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        age, unix_time = (vector_input(self, name, context)[0] for name in ("age", "unix_time"))
        last = _Sent.read(context)
        if unix_time - age > last.measured + SAME_TIME:
            last = _Sent(unix_time - age, last.seq + 1.0, context.get_time())
        discrete_state.set_value(np.array(last))

    def _publish(self, context: Context) -> None:
        last = _Sent.read(context)
        if context.get_time() - last.came < 2.0 * PUBLISH_OFFSET:
            self._send(context, int(last.seq), last.measured)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Received(Received):
    value: np.ndarray  # of the last valid message
    utime: float = -math.inf  # [us] of the last message.
    seq: int = 0
    session: int = 0
    gaps: int = 0


def decode_message(codec: Codec, data: bytes) -> Any:
    """Decodes a packet for `codec.unpack`; raises ValueError or struct.error for another type or
    frame, and for surplus bytes."""
    rest = BytesIO(data)
    message: Any = codec.message.decode(rest)
    surplus = len(rest.read())
    require(not surplus, "surplus bytes of the message", "0", surplus)
    frame = message.header.frame_name
    require(frame == codec.frame, "the frame", repr(codec.frame), repr(frame))
    return message


class MessageSubscriber(Receiver[_Received]):
    """Outputs the signal of the last LCM message, its age, and numbers of lost and rejected ones.

    .. pydrake_system::

        name: MessageSubscriber
        input_ports: [unix_time]
        output_ports: [(port of the codec), age, gaps, rejected]

    - ``unix_time`` (1): [s], see `UnixClock`.
    - The port of the codec: the last vector or image; before the first ``initial``, by default NaN
      or a black image.
    - ``age`` (1): [s] since the last message was sent, by the sender's clock, which must be
      synchronized with ours; infinity before the first.
    - ``gaps`` (1): number of messages that did not come; a restart of the sender leaves no gap.
    - ``rejected`` (1): number of messages of another type or frame, malformed, not finite, no newer
      than the one before, sent more than 0.2 s ahead of our clock, or by a second sender.
    """

    def __init__(self, lcm: LCM, codec: Codec, period: float, initial: np.ndarray | None = None):
        image = codec.image
        if initial is None:
            initial = np.full(codec.size, np.nan) if image is None else np.asarray(image.data)
        super().__init__(_Received(value=initial.copy()), codec.channel, period)
        self._lcm, self._codec = lcm, codec
        self._inbox = inbox = deque[bytes]()
        subscription = lcm.subscribe(codec.channel, lambda _, data: inbox.append(data))
        subscription.set_queue_capacity(_QUEUE)
        weakref.finalize(self, lcm.unsubscribe, subscription)
        if image is None:
            self._declare(codec.port, codec.size, lambda received, _: received.value)
        else:
            self.DeclareAbstractOutputPort(
                codec.port, lambda: Value(image), weak_callback(self._calc_image), self._state
            )
        self._declare("gaps", 1, lambda received, _: received.gaps)
        self._declare_age(lambda received: received.utime * 1e-6)

    def has_message(self) -> bool:
        """Checks if the next update will see a message."""
        while self._lcm.handle_timeout(0):
            pass
        return bool(self._inbox)

    def _receive(self, context: Context, received: _Received) -> _Received:
        if not self.has_message():
            return received
        messages = list(self._inbox)
        self._inbox.clear()
        unix_time = float(vector_input(self, "unix_time", context)[0])
        epoch = unix_time - context.get_time()

        def read(last: _Received, data: bytes) -> _Received:
            message = decode_message(self._codec, data)
            seq, utime = message.header.seq, message.header.utime
            ahead = utime * 1e-6 - unix_time
            limit, remedy = f"at most {MAX_AHEAD} s ahead", "synchronize the clocks"
            require(ahead <= MAX_AHEAD, "the time of the message", limit, f"{ahead:.3f} s", remedy)
            later = utime - last.utime  # [us]
            require(later > 0, "the message", "newer than the one before", f"{later} us")
            session = getattr(message, "session", 0)  # Images, whose type is Drake's, have none.
            if later < RESTART * 1e6 and (session != last.session or seq < last.seq):
                raise ValueError("there are two senders on this channel; end one of them")
            gaps = last.gaps + (0 if math.isinf(later) else max(seq - last.seq - 1, 0))
            value = self._codec.unpack(message, epoch)
            return replace(last, value=value, utime=utime, seq=seq, session=session, gaps=gaps)

        return self._take(received, messages, 0, read)

    def _calc_image(self, context: Context, output) -> None:
        output.get_mutable_value().mutable_data[:] = self._received(context).value


@contextmanager
def recorded(lcm: LCM, path: Path, overwrite: bool = False) -> Iterator[None]:
    """Writes the messages of all channels into a log, with the times of their arrival. A full disk
    ends the log, with one warning, but not the flight."""
    require_unused(path, overwrite)
    log, is_writable = EventLog(path, "w", overwrite=overwrite), True

    def write(channel: str, data: bytes) -> None:
        nonlocal is_writable
        try:
            if is_writable:
                log.write_event(time.time_ns() // 1000, channel, data)
        except OSError as error:
            is_writable = False
            _log.warning("%s cannot be written, the log ends here: %s", path, error.strerror)

    subscription = lcm.subscribe(".*", write)
    subscription.set_queue_capacity(10_000)  # They wait while a world is made.
    try:
        yield
    finally:
        lcm.unsubscribe(subscription)
        log.close()


def replay(path: Path, lcm: LCM, simulator: Simulator, clock: UnixClock) -> None:
    """Simulates a diagram, from time 0, that receives the messages of a log at the times of their
    arrival, by an LCM of `memq://`, bitwise repeatably; `clock` is the diagram's."""
    require_file(path)
    events = [(event.timestamp, event.channel, event.data) for event in EventLog(path)]
    require(events, str(path), "a log of LCM with messages", "none")
    root = simulator.get_mutable_context()
    first = events[0][0]
    clock.set_epoch(root, first * 1e-6)
    for timestamp, channel, data in events:
        simulator.AdvanceTo(max((timestamp - first) * 1e-6, root.get_time()))
        lcm.publish(channel, data)
    simulator.AdvancePendingEvents()
