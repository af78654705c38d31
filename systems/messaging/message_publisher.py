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

    - The port that the codec names: the vector or image that is sent.
    - ``unix_time`` (1): [s], see :class:`UnixClock`.
    - ``enabled`` (1), optional: nothing is sent while it is 0.

    Publishes every ``period`` seconds from time 0, a microsecond later, and when forced. Stateless:
    the sequence number is the Context's time in periods, so that a message that was not sent is
    missing. What it sends on, an ``lcm.LCM``, is outside the Context.
    """

    unix_time_input_port = input_port("unix_time")
    enabled_input_port = input_port("enabled")

    def __init__(self, lcm: LCM, codec: Codec, period: float):
        """Constructs the system.

        Args:
            lcm: to send on.
            codec: of what.
            period: [s] between messages.

        Raises:
            ValueError: unless the period is positive and finite.
        """
        super().__init__()
        if not 0.0 < period < math.inf:
            raise ValueError(
                f"messages on {codec.channel} are {period} s apart; the period must be positive "
                "and finite"
            )
        self._lcm, self._codec, self._period = lcm, codec, period
        if codec.image is None:
            self.DeclareVectorInputPort(codec.port, codec.size)
        else:
            self.DeclareAbstractInputPort(codec.port, Value(codec.image))
        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareVectorInputPort("enabled", 1)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> None:
        enabled = optional_input(self, "enabled", context)
        if enabled is not None and not enabled[0]:
            return
        unix_time = float(np.asarray(self.GetInputPort("unix_time").Eval(context))[0])
        header = lcmt_header()
        header.seq = round((context.get_time() - PUBLISH_OFFSET) / self._period)
        header.utime = round(unix_time * 1e6)
        header.frame_name = self._codec.frame
        value: Any = self.get_input_port(0).Eval(context)
        array = np.asarray(value if self._codec.image is None else value.data)
        message = self._codec.pack(array, header, unix_time - context.get_time())
        if message is not None:
            self._lcm.publish(self._codec.channel, message.encode())
