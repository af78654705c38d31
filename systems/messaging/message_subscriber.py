"""MessageSubscriber: gives what messages brought."""

import math
import weakref
from collections import deque
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
from lcm import LCM
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.messaging.received import RESTART, Received
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.weakly import weakly

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
