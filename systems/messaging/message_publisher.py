"""MessagePublisher: sends what comes in on its port."""

import math
from typing import Any

import numpy as np
from drake import lcmt_header
from lcm import LCM
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem

from splatpilot.systems.messaging.codecs import Codec
from splatpilot.systems.ports import input_port, optional_input

PUBLISH_OFFSET = 1e-6
"""[s] after the updates of an instant at which their results are sent: publish events of that very
instant would see what was before the updates."""


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
        unix_time = float(np.asarray(self.GetInputPort("unix_time").Eval(context))[0])
        header = lcmt_header()
        header.seq = math.floor(context.get_time() / self._period + 1e-6)
        header.utime = round(unix_time * 1e6)
        header.frame_name = self._codec.frame
        value: Any = self.get_input_port(0).Eval(context)
        array = np.asarray(value if self._codec.image is None else value.data)
        message = self._codec.pack(array, header, unix_time - context.get_time())
        if message is not None:
            self._lcm.publish(self._codec.channel, message.encode())
