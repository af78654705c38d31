"""TimeOfFlightReceiver: the grid that a time-of-flight sensor streams by UDP."""

import math
import socket
import weakref
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from splatpilot.systems.common.drake import output_port
from splatpilot.systems.messaging.lcm_ports import RESTART, Received
from splatpilot.systems.sensing.time_of_flight import Stream, TimeOfFlight, after_packet

_LARGEST = 65536
_BUFFER = 4_000_000  # [bytes] that wait in the kernel: a second of raw frames.


@dataclass
class UdpConfig:
    """Where packets come to, and from whom."""

    # Port that packets come to.
    port: int = 5600
    # Address that packets come to: that of this host only, or 0.0.0.0 for all networks.
    host: str = "127.0.0.1"
    # Addresses of who may send; packets of others are dropped and counted.
    senders: list[str] = field(default_factory=lambda: ["127.0.0.1"])
    # Multicast group that packets are sent to, of the network that `host` is in; none where empty.
    group: str = ""

    def validate(self, name: str) -> None:
        """Raises ValueError on a value out of range, naming it as a field of `name`."""
        if not 0 <= self.port <= 65535:
            raise ValueError(f"{name}.port is {self.port}; it must be 0 to 65535")
        for what, addresses in (
            ("host", [self.host]),
            ("senders", self.senders),
            ("group", [self.group] if self.group else []),
        ):
            for address in addresses:
                try:
                    socket.inet_aton(address)
                except OSError:
                    raise ValueError(
                        f"{name}.{what} is {address!r}; it must be an IPv4 address, as 127.0.0.1"
                    ) from None
        if self.group and not 224 <= int(self.group.partition(".")[0]) <= 239:
            raise ValueError(
                f"{name}.group is {self.group!r}; it must be 224.0.0.0 to 239.255.255.255"
            )
        if not self.senders:
            raise ValueError(f"{name}.senders is empty; name who may send")


class Datagrams(NamedTuple):
    """What has come since somebody looked."""

    packets: list[bytes]
    strangers: int  # Packets of others than the senders, which are gone.


class UdpInbox:
    """
    A socket that is read without waiting.

    Raises:
        OSError: if the port is in use or the address is not this host's.
    """

    def __init__(self, config: UdpConfig) -> None:
        self._senders = frozenset(config.senders)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        try:
            self._socket.bind((config.group or config.host, config.port))
            if config.group:
                membership = socket.inet_aton(config.group) + socket.inet_aton(config.host)
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            self._socket.close()
            raise OSError(
                f"UDP packets cannot come to {config.host}:{config.port}: {error.strerror}; use "
                "another port, or an address of this host"
            ) from None

    @property
    def port(self) -> int:
        """That packets come to: the system's choice where the configuration has 0."""
        return self._socket.getsockname()[1]

    def close(self) -> None:
        """Gives the port back."""
        self._socket.close()

    def send(self, packet: bytes, address: tuple[str, int]) -> bool:
        """Sends a packet from this port; returns whether it left, which it does not where there is
        no way to the host."""
        try:
            self._socket.sendto(packet, address)
        except OSError:
            return False
        return True

    def receive(self) -> Datagrams:
        """What has come, oldest first."""
        packets, strangers = [], 0
        while True:
            try:
                packet, (sender, _) = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                return Datagrams(packets, strangers)
            except ConnectionError:  # A packet that was sent from this port reached nobody.
                continue
            if sender in self._senders:
                packets.append(packet)
            else:
                strangers += 1


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
      :class:`~splatpilot.systems.sensing.time_of_flight.TimeOfFlightGrid`; zeros before
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
