"""Where messages travel."""

import logging
import math
import os
import struct
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

import numpy as np
from drake import lcmt_header
from lcm import LCM, EventLog
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, State

from splatpilot.systems.common.drake import input_port, optional_input, output_port, weakly
from splatpilot.systems.common.files import require_unused
from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import Codec

DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4000000"
"""LCM's own group and port, seen on this host only (ttl=0); a buffer for images."""

_PROBE = "SPLATPILOT_PROBE"

# LCM waits by select(), which overwrites its stack for files numbered from 1024; it opens several.
_MOST_FILES = 1000


def open_lcm(url: str = DEFAULT_URL) -> LCM:
    """
    Opens LCM and makes sure that it delivers.

    Args:
        url: as LCM has it, `udpm://GROUP:PORT?ttl=HOPS` or, within this process, `memq://`.

    Raises:
        OSError: if there is no such provider, the port is in use by something else, or there is no
            route for multicast.
    """
    if not url.startswith(("udpm://", "memq://")):
        raise OSError(f"the LCM URL is {url!r}; it must begin with udpm:// or memq://")
    with open(os.devnull) as file:
        if file.fileno() >= _MOST_FILES:
            raise OSError(
                f"LCM cannot use {url}: {file.fileno()} files are open in this process, at most "
                f"{_MOST_FILES} may be; close what is no longer needed"
            )
    heard = []
    try:
        lcm = LCM(url)
        probe = lcm.subscribe(_PROBE, lambda _, data: heard.append(data))
        deadline = time.monotonic() + 2.0
        # It gives no subscription where it cannot have the port; why is on standard error.
        while probe is not None and not heard and time.monotonic() < deadline:
            lcm.publish(_PROBE, b"")
            lcm.handle_timeout(100)
    except (RuntimeError, OSError) as error:
        raise OSError(f"LCM cannot use {url}: {error}; {_REMEDY}") from None
    if probe is None or not heard:
        raise OSError(f"LCM at {url} does not deliver its own messages; {_REMEDY}")
    lcm.unsubscribe(probe)
    return lcm


_REMEDY = (
    "use a multicast group and a port that only LCM has, and give the host a multicast route "
    "(ip route add 224.0.0.0/4 dev lo)"
)


PUBLISH_OFFSET = 1e-6
"""[s] after the updates of an instant at which their results are sent: publish events of that very
instant would see what was before the updates."""

SAME_TIME = 1e-4
"""[s] within which two times at which something was measured, told by its age, are the same."""


class MessagePublisher(LeafSystem):
    """Sends a signal in LCM messages.

    .. pydrake_system::

        name: MessagePublisher
        input_ports:
        - (port of the codec)
        - unix_time
        - enabled
        - decided

    - The port that the codec names: the vector or image that is sent.
    - ``unix_time`` (1): [s], see :class:`UnixClock`.
    - ``enabled`` (1), optional: nothing is sent while it is 0.

    - ``decided`` (1), optional: [s], when what is sent was decided last; between two of its times a
      publisher with a ``tick`` sends what is decided there at once.

    Publishes every ``period`` seconds from time 0, a microsecond later, and when forced. Stateless:
    the sequence number is the Context's time in whole periods, so that a message that was not sent
    is missing, and one between two of its times has the number of the one before. What it sends on,
    an ``lcm.LCM``, is outside the Context.
    """

    unix_time_input_port = input_port("unix_time")
    enabled_input_port = input_port("enabled")
    decided_input_port = input_port("decided")

    def __init__(self, lcm: LCM, codec: Codec, period: float, tick: float | None = None):
        """Constructs the system.

        Args:
            lcm: to send on.
            codec: of what.
            period: [s] between messages.
            tick: [s] between looks at what was decided; at no time if None.

        Raises:
            ValueError: unless period and tick are positive and finite.
        """
        super().__init__()
        for number, what in ((period, "apart"), (tick, "late at most")):
            if number is not None and not 0.0 < number < math.inf:
                raise ValueError(
                    f"messages on {codec.channel} are {number} s {what}; that must be positive and "
                    "finite"
                )
        self._lcm, self._codec, self._period = lcm, codec, period
        if codec.image is None:
            self.DeclareVectorInputPort(codec.port, codec.size)
        else:
            self.DeclareAbstractInputPort(codec.port, Value(codec.image))
        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareVectorInputPort("enabled", 1)
        self.DeclareVectorInputPort("decided", 1)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)
        if tick is not None:
            self.DeclarePeriodicPublishEvent(tick, PUBLISH_OFFSET, self._publish_decided)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish_decided(self, context: Context) -> None:
        decided = optional_input(self, "decided", context)
        now = context.get_time() - PUBLISH_OFFSET
        is_due = abs(math.remainder(now, self._period)) < PUBLISH_OFFSET  # And is sent anyway.
        if decided is not None and now - decided[0] < PUBLISH_OFFSET and not is_due:
            self._publish(context)

    def _publish(self, context: Context) -> None:
        enabled = optional_input(self, "enabled", context)
        if enabled is not None and not enabled[0]:
            return
        seq = math.floor(context.get_time() / self._period + 1e-6)
        unix_time = float(np.asarray(self.GetInputPort("unix_time").Eval(context))[0])
        _send(self, context, self._lcm, self._codec, seq, unix_time)


class _Sent(NamedTuple):
    """The discrete state of a `MeasurementPublisher`."""

    measured: float = -math.inf  # [s], Unix time of the newest measurement.
    number: float = -1.0  # Of its message.
    came: float = -math.inf  # [s], when it came.


class MeasurementPublisher(LeafSystem):
    """Sends each measurement in an LCM message, once and as it comes.

    .. pydrake_system::

        name: MeasurementPublisher
        input_ports:
        - (port of the codec)
        - age
        - unix_time

    - The port that the codec names: the vector that was measured last.
    - ``age`` (1): [s] since it was measured; infinite before the first.
    - ``unix_time`` (1): [s], see :class:`UnixClock`.

    Messages bear the time of the measurement. Looks every ``period`` seconds from time 0 and sends
    a microsecond later. What was measured no later than the measurement before is not sent: a
    source that falls silent grows old at the subscriber.
    """

    age_input_port = input_port("age")
    unix_time_input_port = input_port("unix_time")

    def __init__(self, lcm: LCM, codec: Codec, period: float):
        """Constructs the system.

        Args:
            lcm: to send on.
            codec: of what.
            period: [s] between looks at whether a measurement has come.
        """
        super().__init__()
        self._lcm, self._codec = lcm, codec
        self.DeclareVectorInputPort(codec.port, codec.size)
        self.DeclareVectorInputPort("age", 1)
        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareDiscreteState(np.array(_Sent()))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._look)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        age, unix_time = (
            float(np.asarray(self.GetInputPort(name).Eval(context))[0])
            for name in ("age", "unix_time")
        )
        last = _sent(context)
        if unix_time - age > last.measured + SAME_TIME:
            last = _Sent(unix_time - age, last.number + 1.0, context.get_time())
        discrete_state.set_value(np.array(last))

    def _publish(self, context: Context) -> None:
        last = _sent(context)
        if context.get_time() - last.came < 2.0 * PUBLISH_OFFSET:
            _send(self, context, self._lcm, self._codec, int(last.number), last.measured)


def _sent(context: Context) -> _Sent:
    return _Sent(*np.asarray(context.get_discrete_state_vector().value()))


def _send(
    system: LeafSystem, context: Context, lcm: LCM, codec: Codec, seq: int, stamp: float
) -> None:
    """Sends what is at input port 0 of a publisher, as of the Unix time `stamp` [s]."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = seq, round(stamp * 1e6), codec.frame
    unix_time = float(np.asarray(system.GetInputPort("unix_time").Eval(context))[0])
    value: Any = system.get_input_port(0).Eval(context)
    array = np.asarray(value if codec.image is None else value.data)
    message = codec.pack(array, header, unix_time - context.get_time())
    if message is not None:
        lcm.publish(codec.channel, message.encode())


_log = logging.getLogger(__name__)

RESTART = 1.0
"""[s], after which a stream that fell silent may be another."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Received:
    """What a receiver keeps, in the abstract state 0 of its Context. Nothing in it changes:
    Contexts, which copy it at every update, may share it."""

    rejected: int = 0
    """Messages that were of no use."""

    def __deepcopy__(self, memo: dict) -> Self:
        return self

    def rejecting(self, count: int, source: str, why: str) -> Self:
        """With `count` more that were of no use; the first, second, fourth, eighth... is logged."""
        total = self.rejected + count
        if total.bit_length() != self.rejected.bit_length():
            _log.warning("%s: a message is refused, %d so far: %s", source, total, why)
        return replace(self, rejected=total)

    def taking[R: Received](
        self: R,
        messages: Iterable[bytes],
        strangers: int,
        source: str,
        after: Callable[[R, bytes], R],
    ) -> R:
        """After messages, and after others of `strangers`, which are rejected. `after` says what
        there is after one more; one for which it raises ValueError or struct.error is rejected."""
        received = self
        if strangers:
            received = received.rejecting(strangers, source, "its sender is not named")
        for message in messages:
            try:
                received = after(received, message)
            except (ValueError, struct.error) as error:
                received = received.rejecting(1, source, str(error))
        return received

    @classmethod
    def of(cls, context: Context) -> Self:
        """That in a receiver's Context."""
        return cast(Self, context.get_abstract_state(0).get_value())

    def keep(self, state: State) -> None:
        """Makes this what there is."""
        state.get_mutable_abstract_state(0).set_value(self)

    @classmethod
    def output(cls, value: Callable[[Self, float], Any]) -> Callable[[Context, BasicVector], None]:
        """The callback of a port that gives `value` of what there is and of the time [s]."""

        def calc(context: Context, output: BasicVector) -> None:
            numbers = value(cls.of(context), context.get_time())
            output.SetFromVector(np.atleast_1d(numbers).astype(float))

        return calc


MAX_AHEAD = 0.2
"""[s] by which the clock of who sends may be ahead of ours, which is behind while we are busy."""

_QUEUE = 1000
"""Messages that wait at most; further ones are lost. LCM's 30 are but half a second of states."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Received(Received):
    value: np.ndarray  # of the last message that could be used
    utime: int | None = None  # [us], of the last message; None before the first.
    seq: int = 0
    session: int = 0
    gaps: int = 0


def decode_message(codec: Codec, data: bytes) -> Any:
    """The message in a packet, for `codec.unpack`.

    Raises:
        ValueError, struct.error: if it is none of the codec's, is longer than its content, or has
            another frame.
    """
    rest = BytesIO(data)
    message: Any = codec.message.decode(rest)
    if rest.read(1):
        raise ValueError(f"the message has {len(data)} bytes; it is longer than its content")
    if message.header.frame_name != codec.frame:
        raise ValueError(f"the frame is {message.header.frame_name!r}; it must be {codec.frame!r}")
    return message


class MessageSubscriber(LeafSystem):
    """Gives the signal of the last LCM message, its age, and how many were lost or of no use.

    .. pydrake_system::

        name: MessageSubscriber
        input_ports:
        - unix_time
        output_ports:
        - (port of the codec)
        - age
        - gaps
        - rejected

    - ``unix_time`` (1): [s], see :class:`UnixClock`.
    - The port that the codec names: the vector or image of the last message; ``initial`` before the
      first.
    - ``age`` (1): [s] since the last message was sent, by its own clock, which must be ours or
      synchronised with it; infinity before the first.
    - ``gaps`` (1): how many messages were sent between those that came. A sender that starts again
      leaves no gap.
    - ``rejected`` (1): how many came but were of another type, malformed, not finite, in another
      frame, no newer than the one before, sent more than 0.2 s ahead of our clock, or by a second
      sender, which is not heard while the first sends. The reason is logged at the first, second,
      fourth, eighth... rejection.

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update: discrete
    updates of the same instant see it. All of that is in the Context; outside of it are the
    ``lcm.LCM``, which keeps 1000 messages, and what other subscribers made it deliver meanwhile.
    """

    unix_time_input_port = input_port("unix_time")
    age_output_port = output_port("age")
    gaps_output_port = output_port("gaps")
    rejected_output_port = output_port("rejected")

    def __init__(self, lcm: LCM, codec: Codec, period: float, initial: np.ndarray | None = None):
        """Constructs the system.

        Args:
            lcm: to receive from.
            codec: what is received.
            period: [s] between looks at what has come.
            initial: the value before the first message; NaN, or black images, if None.

        Raises:
            ValueError: unless the period is positive and finite.
        """
        super().__init__()
        if not 0.0 < period < math.inf:
            raise ValueError(
                f"messages on {codec.channel} are looked for every {period} s; the period must be "
                "positive and finite"
            )
        self._lcm, self._codec = lcm, codec
        self._inbox = inbox = deque[bytes]()
        subscription = lcm.subscribe(codec.channel, lambda _, data: inbox.append(data))
        subscription.set_queue_capacity(_QUEUE)
        weakref.finalize(self, lcm.unsubscribe, subscription)
        self.DeclareVectorInputPort("unix_time", 1)
        image = codec.image
        if initial is None:
            initial = np.full(codec.size, np.nan) if image is None else np.asarray(image.data)
        received = self.DeclareAbstractState(Value(_Received(value=initial.copy())))
        ticket = {self.abstract_state_ticket(received)}
        if image is None:
            vector = _Received.output(lambda received, _: received.value)
            self.DeclareVectorOutputPort(codec.port, codec.size, vector, ticket)
        else:
            self.DeclareAbstractOutputPort(
                codec.port, lambda: Value(image), weakly(self._calc_image), ticket
            )
        self.DeclareVectorOutputPort("age", 1, self._calc_age)
        gaps = _Received.output(lambda received, _: received.gaps)
        rejected = _Received.output(lambda received, _: received.rejected)
        self.DeclareVectorOutputPort("gaps", 1, gaps, ticket)
        self.DeclareVectorOutputPort("rejected", 1, rejected, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    @property
    def channel(self) -> str:
        """Where the messages come from."""
        return self._codec.channel

    def has_message(self) -> bool:
        """Whether anything has come that the next update will look at."""
        while self._lcm.handle_timeout(0):
            pass
        return bool(self._inbox)

    def _take(self, context: Context, state: State) -> None:
        if not self.has_message():
            return
        unix_time = self._unix_time(context)
        epoch = unix_time - context.get_time()
        messages = list(self._inbox)
        self._inbox.clear()

        def after(last: _Received, message: bytes) -> _Received:
            return self._after(last, message, unix_time, epoch)

        _Received.of(context).taking(messages, 0, self.channel, after).keep(state)

    def _after(self, last: _Received, data: bytes, unix_time: float, epoch: float) -> _Received:
        """What there is after another message; raises ValueError or struct.error to refuse it."""
        message = decode_message(self._codec, data)
        header = message.header
        ahead = header.utime * 1e-6 - unix_time
        if ahead > MAX_AHEAD:
            raise ValueError(
                f"the message is from {ahead:.3f} s ahead of our clock; at most {MAX_AHEAD} s are "
                "allowed: synchronise the clocks"
            )
        if last.utime is not None and header.utime <= last.utime:
            raise ValueError("the message is no newer than the one before")
        session = getattr(message, "session", 0)  # Images, whose type is Drake's, have none.
        if last.utime is not None and header.utime - last.utime < RESTART * 1e6:
            if session != last.session or header.seq < last.seq:
                raise ValueError("there are two senders on this channel; end one of them")
        value = self._codec.unpack(message, epoch)
        lost = header.seq - last.seq - 1 if last.utime is not None else 0
        gaps = last.gaps + max(lost, 0)
        return replace(
            last,
            value=value,
            utime=header.utime,
            seq=header.seq,
            session=session,
            gaps=gaps,
        )

    def _unix_time(self, context: Context) -> float:
        return float(np.asarray(self.get_input_port().Eval(context))[0])

    def _calc_image(self, context: Context, output) -> None:
        output.get_mutable_value().mutable_data[:] = _Received.of(context).value

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        utime = _Received.of(context).utime
        output[0] = math.inf if utime is None else self._unix_time(context) - utime * 1e-6


_logger = logging.getLogger(__name__)


@contextmanager
def recorded(lcm: LCM, path: Path, overwrite: bool = False) -> Iterator[None]:
    """
    Writes what comes by LCM, on all channels, into a log, each message with the time at which the
    LCM was asked for it.

    A disk that is full ends the log, with one warning, but not the flight that it is a log of.

    Raises:
        OSError: if there is such a file already, unless with `overwrite`, or it cannot be made.
    """
    require_unused(path, overwrite)
    log, is_writable = EventLog(path, "w", overwrite=overwrite), True

    def write(channel: str, data: bytes) -> None:
        nonlocal is_writable
        if not is_writable:
            return
        try:
            log.write_event(time.time_ns() // 1000, channel, data)
        except OSError as error:
            is_writable = False
            _logger.warning("%s cannot be written, the log ends here: %s", path, error.strerror)

    subscription = lcm.subscribe(".*", write)
    subscription.set_queue_capacity(10_000)  # They wait while a world is made.
    try:
        yield
    finally:
        lcm.unsubscribe(subscription)
        log.close()


def replay(path: Path, lcm: LCM, simulator: Simulator, clock: UnixClock) -> None:
    """
    Simulates a diagram while it receives the messages of a log, each when it came.

    The same log gives the same simulation, bit for bit.

    Args:
        path: of the log.
        lcm: that the diagram's systems were made with, of `memq://`.
        simulator: of the diagram, at time 0, which is when the first message came.
        clock: of the diagram.

    Raises:
        OSError: if the log cannot be read.
        ValueError: if it has no messages.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such log")
    events = [(event.timestamp, event.channel, event.data) for event in EventLog(path)]
    if not events:
        raise ValueError(f"{path} holds no messages; it is empty, or no log of LCM")
    root = simulator.get_mutable_context()
    first = events[0][0]
    clock.set_epoch(clock.GetMyMutableContextFromRoot(root), first * 1e-6)
    for timestamp, channel, data in events:
        simulator.AdvanceTo(max((timestamp - first) * 1e-6, root.get_time()))
        lcm.publish(channel, data)
    simulator.AdvancePendingEvents()
