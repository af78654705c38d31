"""Receiver: base of systems that receive messages; UDP packets, and a sensor that sends them."""

import contextlib
import logging
import math
import socket
import struct
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from ipaddress import AddressValueError, IPv4Address
from typing import Any, Protocol, Self, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.common.drake import vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.time_of_flight import Stream, TimeOfFlight, after_packet

RESTART = 1.0  # [s] Silence after which a stream may be another.

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Received:
    """State of a `Receiver`. It is immutable, and Contexts share it."""

    rejected: int = 0  # Number of messages that could not be used.

    def __deepcopy__(self, memo: dict) -> Self:
        return self


class Receiver[R: Received](LeafSystem):
    """Base of systems that take all messages of a `source` every `period` [s] from time 0.

    The update is unrestricted: discrete updates of the same instant see it. The output ``rejected``
    (1) counts messages that could not be used; reasons are logged at the first, second, fourth,
    eighth... `now` is the Unix time [s] by the wall clock; by default the input `unix_time`.
    """

    def __init__(
        self, initial: R, source: str, period: float, now: Callable[[], float] | None = None
    ):
        super().__init__()
        self.source, self._now = source, now
        self._state = {self.abstract_state_ticket(self.DeclareAbstractState(Value(initial)))}
        self._declare("rejected", 1, lambda received, _: received.rejected)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)

    def _receive(self, context: Context, received: R) -> R:
        """Returns the state after all messages that have come."""
        raise NotImplementedError

    def _declare(
        self, name: str, size: int, value: Callable[[R, float], Any], timed: bool = False
    ) -> None:
        """Declares an output: `value` of the state and, if `timed`, the time [s]."""

        def calc(context: Context, output: BasicVector) -> None:
            numbers = np.ravel(value(self._received(context), context.get_time()))
            output.SetFromVector(numbers.astype(float))

        tickets = {self.all_sources_ticket()} if timed else self._state
        self.DeclareVectorOutputPort(name, size, calc, tickets)

    def _declare_age(self, stamp: Callable[[R], float]) -> None:
        """Declares the input `unix_time` and the output `age` since a Unix time `stamp` [s]."""

        def calc(context: Context, output: BasicVector) -> None:
            unix_time = vector_input(self, "unix_time", context)[0]
            output[0] = unix_time - stamp(self._received(context))

        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareVectorOutputPort("age", 1, calc)

    def _received(self, context: Context) -> R:
        return cast(R, context.get_abstract_state(0).get_value())

    def _update(self, context: Context, state: State) -> None:
        received = self._receive(context, self._received(context))
        state.get_mutable_abstract_state(0).set_value(received)

    def _time_of_reading(self, context: Context) -> float:
        """Returns the Unix time [s] after messages have been read. By the Context's time, which may
        be behind, they would seem to have come before they were sent."""
        return self._now() if self._now else float(vector_input(self, "unix_time", context)[0])

    def _take(
        self, received: R, messages: Iterable[bytes], strangers: int, read: Callable[[R, bytes], R]
    ) -> R:
        """Reads messages by `read`, which returns the state after one; rejects those for which it
        raises ValueError or struct.error, and a number of messages of strangers."""
        if strangers:
            received = self._reject(received, "its sender is not in `senders`", strangers)
        for message in messages:
            try:
                received = read(received, message)
            except (ValueError, struct.error) as error:
                received = self._reject(received, str(error))
        return received

    def _reject(self, received: R, reason: str, count: int = 1) -> R:
        total = received.rejected + count
        if total.bit_length() != received.rejected.bit_length():
            _log.warning("%s: message rejected, %d so far: %s", self.source, total, reason)
        return replace(received, rejected=total)


_MAX_PACKET = 65536  # [bytes]
_BUFFER = 4_000_000  # [bytes] in the kernel: a second of raw frames.


@dataclass
class UdpConfig(Config):
    """Address at which packets arrive, and their senders."""

    # Port at which packets arrive.
    port: int = bounded(5600, "[0, 65535]")
    # Address at which packets arrive: that of this host only, or 0.0.0.0 for all networks.
    host: str = "127.0.0.1"
    # Addresses of senders; packets of others are dropped and counted.
    senders: list[str] = field(default_factory=lambda: ["127.0.0.1"])
    # Multicast group that packets are sent to, in the network of `host`; none if empty.
    group: str = ""

    def check(self) -> None:
        groups = [self.group] if self.group else []
        given = {"host": [self.host], "senders": self.senders, "group": groups}
        for name, addresses in given.items():
            valid = all(map(_is_address, addresses))
            require_field(self, name, valid, "an IPv4 address, as 127.0.0.1")
        multicast = not self.group or IPv4Address(self.group).is_multicast
        require_field(self, "group", multicast, "in 224.0.0.0 to 239.255.255.255")
        require_field(self, "senders", self.senders, "a list of at least one address")


def _is_address(address: str) -> bool:
    try:
        IPv4Address(address)
    except AddressValueError:
        return False
    return True


class Inbox(Protocol):
    """Receives packets, and sends some back."""

    port: int

    def send(self, packet: bytes, address: tuple[str, int]) -> None: ...

    def receive(self) -> tuple[list[bytes], int]: ...


class UdpInbox:
    """A socket that is read without waiting; OSError if the port is in use."""

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
                f"cannot receive UDP packets at {config.host}:{config.port}: {error.strerror}; use "
                "another port, or an address of this host"
            ) from None

        self.port: int = self._socket.getsockname()[1]  # Chosen by the kernel if configured as 0.
        self.close = self._socket.close

    def send(self, packet: bytes, address: tuple[str, int]) -> None:
        """Sends a packet from this port, if there is a route to the host."""
        with contextlib.suppress(OSError):
            self._socket.sendto(packet, address)

    def receive(self) -> tuple[list[bytes], int]:
        """Returns the packets that have come, oldest first, and how many of strangers."""
        packets, strangers = [], 0
        while True:
            try:
                packet, (sender, _) = self._socket.recvfrom(_MAX_PACKET)
            except BlockingIOError:
                return packets, strangers
            except ConnectionError:  # A packet that was sent from this port was not received.
                continue
            if sender in self._senders:
                packets.append(packet)
            else:
                strangers += 1


@dataclass
class TimeOfFlightStream(Config):
    """The stream of a time-of-flight sensor."""

    udp: UdpConfig = field(default_factory=UdpConfig)
    sensor: TimeOfFlight = field(default_factory=TimeOfFlight)
    # [s] Age of images on arrival; the sensor's clock is another.
    latency: float = bounded(0.03, "[0, 1] s")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Grid(Received):
    stream: Stream = field(default_factory=Stream)
    time: float = -math.inf  # [s] of the Context, when the last grid came.


class TimeOfFlightReceiver(Receiver[_Grid]):
    """Outputs the last grid of a stream, its age, and the numbers of lost and rejected packets.

    .. pydrake_system::

        name: TimeOfFlightReceiver
        output_ports: [depth_grid, age, gaps, rejected]

    - ``depth_grid`` (rows * columns): see `TimeOfFlightGrid`; zeros before the first.
    - ``age`` (1): [s] since the exposure of the last; infinity before the first.
    - ``gaps`` (1), ``rejected`` (1): numbers of images that did not come, and of packets that were
      invalid, of other senders, or no newer than the one before.
    """

    def __init__(self, config: TimeOfFlightStream, period: float):
        config.validate()
        inbox = UdpInbox(config.udp)
        super().__init__(_Grid(), f"UDP port {inbox.port}", period)
        weakref.finalize(self, inbox.close)
        self._sensor, self._inbox, self.port = config.sensor, inbox, inbox.port
        self._waiting: list[tuple[list[bytes], int]] = []
        latency, empty = config.latency, np.zeros((config.sensor.rows, config.sensor.columns))
        grid = lambda got, _: empty if got.stream.grid is None else got.stream.grid  # noqa: E731
        self._declare("depth_grid", empty.size, grid)
        self._declare("age", 1, lambda got, now: now - got.time + latency, timed=True)
        self._declare("gaps", 1, lambda got, _: got.stream.gaps)

    def has_message(self) -> bool:
        """Checks if the next update will see a packet."""
        self._waiting.append(self._inbox.receive())
        return any(packets for packets, _ in self._waiting)

    def _receive(self, context: Context, received: _Grid) -> _Grid:
        now = context.get_time()

        def read(received: _Grid, packet: bytes) -> _Grid:
            last = received.stream
            if now - received.time > RESTART:  # Its clock may have started again.
                last = replace(last, time_ns=-1, seq=-1)
            stream = after_packet(last, packet, self._sensor)
            time = now if stream.time_ns > last.time_ns else received.time
            return replace(received, stream=stream, time=time)

        for datagrams in (*self._waiting, self._inbox.receive()):
            received = self._take(received, *datagrams, read)
        self._waiting.clear()
        return received
