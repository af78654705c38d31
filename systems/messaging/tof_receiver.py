"""TimeOfFlightReceiver: receives the stream of a time-of-flight sensor by UDP."""

import math
import weakref
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.systems.framework import Context

from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.messaging.receiver import (
    RESTART,
    Datagrams,
    Received,
    Receiver,
    UdpConfig,
    UdpInbox,
)
from splatpilot.systems.sensing.time_of_flight import Stream, TimeOfFlight, after_packet


@dataclass
class TimeOfFlightStream(Config):
    """The stream of a time-of-flight sensor."""

    udp: UdpConfig = field(default_factory=UdpConfig)
    sensor: TimeOfFlight = field(default_factory=TimeOfFlight)
    # [s] Age of images on arrival; the sensor's clock is another.
    latency: float = bounded(0.03, "[0, 1] s")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Received(Received):
    stream: Stream = field(default_factory=Stream)
    time: float = -math.inf  # [s] of the Context, when the last grid came.


class TimeOfFlightReceiver(Receiver[_Received]):
    """Outputs the last grid of a stream, its age, and the numbers of lost and rejected packets.

    .. pydrake_system::

        name: TimeOfFlightReceiver
        output_ports: [depth_grid, age, gaps, rejected]

    - ``depth_grid`` (rows * columns): see
      :class:`~splatpilot.systems.sensing.time_of_flight.TimeOfFlightGrid`; zeros before
      the first.
    - ``age`` (1): [s] since the exposure of the last; infinity before the first.
    - ``gaps`` (1): number of images that were sent between those that came.
    - ``rejected`` (1): number of packets of another length, type or size, of other senders, or no
      newer than the one before.
    """

    def __init__(self, config: TimeOfFlightStream, period: float):
        """Constructs the system.

        Args:
            config: of the stream.
            period: [s] between updates.
        """
        config.validate()
        inbox = UdpInbox(config.udp)
        super().__init__(_Received(), f"UDP port {inbox.port}", period)
        weakref.finalize(self, inbox.close)
        self._config, self._inbox = config, inbox
        self._waiting: list[Datagrams] = []
        size = config.sensor.rows * config.sensor.columns
        nothing, latency = np.zeros(size), config.latency
        self._declare(
            "depth_grid",
            size,
            lambda got, _: nothing if got.stream.grid is None else got.stream.grid.ravel(),
        )
        self._declare("age", 1, lambda got, now: now - got.time + latency, timed=True)
        self._declare("gaps", 1, lambda got, _: got.stream.gaps)

    @property
    def port(self) -> int:
        """The UDP port at which the stream arrives."""
        return self._inbox.port

    def has_message(self) -> bool:
        """Checks if the next update will see a packet."""
        self._waiting.append(self._inbox.receive())
        return any(datagrams.packets for datagrams in self._waiting)

    def _receive(self, context: Context, received: _Received) -> _Received:
        now = context.get_time()

        def read(received: _Received, packet: bytes) -> _Received:
            last = received.stream
            if now - received.time > RESTART:  # Its clock may have started again.
                last = last.restarted()
            stream = after_packet(last, packet, self._config.sensor)
            time = now if stream.time_ns > last.time_ns else received.time
            return replace(received, stream=stream, time=time)

        for datagrams in (*self._waiting, self._inbox.receive()):
            received = self._take(received, *datagrams, read)
        self._waiting.clear()
        return received
