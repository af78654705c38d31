"""An inbox of packets that tests write and read."""

from pymavlink.dialects.v20 import common as dialect


class Packets:
    port = 0

    def __init__(self):
        self.sent, self.waiting, self.strangers = b"", [], 0

    def send(self, packet: bytes, address: tuple[str, int]) -> None:
        self.sent += packet

    def receive(self) -> tuple[list[bytes], int]:
        received = self.waiting, self.strangers
        self.waiting, self.strangers = [], 0
        return received

    def take_sent(self) -> list:
        """Returns the MAVLink messages that were sent since the last call."""
        sent, self.sent = self.sent, b""
        return dialect.MAVLink(None).parse_buffer(sent) or []
