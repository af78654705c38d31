"""What comes by UDP, from hosts that are named."""

import socket
from dataclasses import dataclass, field
from typing import NamedTuple

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
