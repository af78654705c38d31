"""Receiver: base of systems that receive messages; UdpInbox: a source of such messages."""

import logging
import socket
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from splatpilot.systems.common.drake import vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field

RESTART = 1.0
"""[s] Silence after which a stream may be another."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Received:
    """State of a `Receiver`. It is immutable, and Contexts share it."""

    rejected: int = 0
    """Number of messages that could not be used."""

    def __deepcopy__(self, memo: dict) -> Self:
        return self


class Receiver[R: Received](LeafSystem):
    """
    Base of systems that take all messages every `period` seconds from time 0.

    The update is unrestricted, so that discrete updates of the same instant see it. All systems
    have the output ``rejected`` (1): the number of messages that could not be used. The reason is
    logged at the first, second, fourth, eighth... rejection.
    """

    def __init__(
        self, initial: R, source: str, period: float, now: Callable[[], float] | None = None
    ):
        """
        Args:
            initial: before the first message.
            source: name of the sender in the log.
            period: [s] between updates.
            now: tells the Unix time [s] of a process that runs with the wall clock; by default it
                is the input `unix_time`.
        """
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
            received = cast(R, context.get_abstract_state(0).get_value())
            numbers = np.atleast_1d(value(received, context.get_time()))
            output.SetFromVector(numbers.astype(float))

        tickets = {self.all_sources_ticket()} if timed else self._state
        self.DeclareVectorOutputPort(name, size, calc, tickets)

    def _declare_age(self, stamp: Callable[[R], float]) -> None:
        """Declares the input `unix_time` and the output `age` since a Unix time `stamp` [s]."""
        self._stamp = stamp
        self.DeclareVectorInputPort("unix_time", 1)
        self.DeclareVectorOutputPort("age", 1, self._calc_age)

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        unix_time = vector_input(self, "unix_time", context)[0]
        output[0] = unix_time - self._stamp(self._received(context))

    def _received(self, context: Context) -> R:
        return cast(R, context.get_abstract_state(0).get_value())

    def _update(self, context: Context, state: State) -> None:
        received = self._receive(context, self._received(context))
        state.get_mutable_abstract_state(0).set_value(received)

    def _time_of_reading(self, context: Context) -> float:
        """
        Returns the Unix time [s] at which messages have been read; call it after that.

        A process may be behind the wall clock, also within an update. By the Context's time,
        messages would seem to have come before they were sent.
        """
        return self._now() if self._now else float(vector_input(self, "unix_time", context)[0])

    def _take(
        self, received: R, messages: Iterable[bytes], strangers: int, read: Callable[[R, bytes], R]
    ) -> R:
        """
        Reads messages.

        Args:
            strangers: number of messages of other senders, which are rejected.
            read: returns the state after a message; ValueError and struct.error reject it.
        """
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
        for name in ("host", "senders", "group"):
            value = getattr(self, name)
            for address in value if isinstance(value, list) else [value] if value else []:
                require_field(self, name, _is_address(address), "an IPv4 address, as 127.0.0.1")
        multicast = not self.group or 224 <= int(self.group.partition(".")[0]) <= 239
        require_field(self, "group", multicast, "in 224.0.0.0 to 239.255.255.255")
        require_field(self, "host", self.host, "an IPv4 address, as 127.0.0.1")
        require_field(self, "senders", self.senders, "a list of at least one address")


def _is_address(address: str) -> bool:
    try:
        socket.inet_aton(address)
    except OSError:
        return False
    return True


class Datagrams(NamedTuple):
    """Packets since the last look."""

    packets: list[bytes]
    strangers: int  # Number of dropped packets of other senders.


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
                f"cannot receive UDP packets at {config.host}:{config.port}: {error.strerror}; use "
                "another port, or an address of this host"
            ) from None

    @property
    def port(self) -> int:
        """The port, chosen by the system if the configuration has 0."""
        return self._socket.getsockname()[1]

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()

    def send(self, packet: bytes, address: tuple[str, int]) -> bool:
        """Sends a packet from this port; returns False if there is no route to the host."""
        try:
            self._socket.sendto(packet, address)
        except OSError:
            return False
        return True

    def receive(self) -> Datagrams:
        """Returns the packets that have come, oldest first."""
        packets, strangers = [], 0
        while True:
            try:
                packet, (sender, _) = self._socket.recvfrom(_MAX_PACKET)
            except BlockingIOError:
                return Datagrams(packets, strangers)
            except ConnectionError:  # A packet that was sent from this port was not received.
                continue
            if sender in self._senders:
                packets.append(packet)
            else:
                strangers += 1
