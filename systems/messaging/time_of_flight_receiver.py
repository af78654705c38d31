"""TimeOfFlightReceiver: the grid that a time-of-flight sensor streams by UDP."""

import math
import weakref
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from splatpilot.systems.messaging.received import RESTART, Received
from splatpilot.systems.messaging.udp_inbox import Datagrams, UdpConfig, UdpInbox
from splatpilot.systems.ports import output_port
from splatpilot.systems.sensing.time_of_flight import TimeOfFlight
from splatpilot.systems.sensing.time_of_flight_packets import Stream, after_packet


@dataclass
class TimeOfFlightStream:
    """Where a sensor streams to, and how."""

    udp: UdpConfig = field(default_factory=UdpConfig)
    sensor: TimeOfFlight = field(default_factory=TimeOfFlight)
    # [s] How old images are when they come: their own clock is another.
    latency: float = 0.03

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.udp.validate("time_of_flight.udp")
        self.sensor.validate()
        if not 0.0 <= self.latency <= 1.0:
            raise ValueError(f"time_of_flight.latency is {self.latency} s; it must be 0 to 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Received(Received):
    stream: Stream = field(default_factory=Stream)
    time: float = -math.inf  # [s], of the Context, when the newest grid came.


class TimeOfFlightReceiver(LeafSystem):
    """Gives the last grid of a stream, its age, and how much of the stream was lost or of no use.

    .. pydrake_system::

        name: TimeOfFlightReceiver
        output_ports:
        - depth_grid
        - age
        - gaps
        - rejected

    - ``depth_grid`` (rows * columns): see
      :class:`~splatpilot.systems.sensing.time_of_flight_grid.TimeOfFlightGrid`; zeros before
      the first.
    - ``age`` (1): [s] since the last was seen; infinity before the first.
    - ``gaps`` (1): how many images were sent between those that came.
    - ``rejected`` (1): how many packets were of another length, kind or size, no newer than the one
      before, or of others than the senders that are named. The reason is logged at the first,
      second, fourth, eighth... rejection.

    Takes what has come every ``period`` seconds from time 0, in an unrestricted update. All of that
    is in the Context; outside of it is the socket.
    """

    depth_grid_output_port = output_port("depth_grid")
    age_output_port = output_port("age")
    gaps_output_port = output_port("gaps")
    rejected_output_port = output_port("rejected")

    def __init__(self, config: TimeOfFlightStream, period: float):
        """Constructs the system.

        Args:
            config: where the sensor streams to.
            period: [s] between looks at what has come.

        Raises:
            ValueError: on a configuration out of range.
            OSError: if the port is in use.
        """
        super().__init__()
        config.validate()
        self._config = config
        self._inbox = inbox = UdpInbox(config.udp)
        weakref.finalize(self, inbox.close)
        self._waiting: list[Datagrams] = []
        state = self.DeclareAbstractState(Value(_Received()))
        ticket = {self.abstract_state_ticket(state)}
        size = config.sensor.rows * config.sensor.columns
        nothing, latency = np.zeros(size), config.latency
        grid = _Received.output(
            lambda got, _: nothing if got.stream.grid is None else got.stream.grid.ravel()
        )
        age = _Received.output(lambda got, now: now - got.time + latency)
        gaps = _Received.output(lambda got, _: got.stream.gaps)
        rejected = _Received.output(lambda got, _: got.rejected)
        self.DeclareVectorOutputPort("depth_grid", size, grid, ticket)
        self.DeclareVectorOutputPort("age", 1, age)
        self.DeclareVectorOutputPort("gaps", 1, gaps, ticket)
        self.DeclareVectorOutputPort("rejected", 1, rejected, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._take)

    @property
    def channel(self) -> str:
        """Where the stream comes to."""
        return f"UDP port {self._inbox.port}"

    @property
    def port(self) -> int:
        """The UDP port that the stream comes to."""
        return self._inbox.port

    def has_message(self) -> bool:
        """Whether anything has come that the next update will look at."""
        self._waiting.append(self._inbox.receive())
        return any(datagrams.packets for datagrams in self._waiting)

    def _take(self, context: Context, state: State) -> None:
        now = context.get_time()

        def after(received: _Received, packet: bytes) -> _Received:
            last = received.stream
            if now - received.time > RESTART:  # Its clock may begin anew.
                last = last.restarted()
            stream = after_packet(last, packet, self._config.sensor)
            time = now if stream.time_ns > last.time_ns else received.time
            return replace(received, stream=stream, time=time)

        received = _Received.of(context)
        for datagrams in (*self._waiting, self._inbox.receive()):
            received = received.taking(*datagrams, self.channel, after)
        self._waiting.clear()
        received.keep(state)
