"""MessagePublisher and MeasurementPublisher: send what comes in on their ports."""

import math
from typing import Any, NamedTuple

import numpy as np
from drake import lcmt_header
from lcm import LCM
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.ports import input_port, optional_input

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
