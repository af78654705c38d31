"""Receiver and UdpInbox."""

import copy
import logging
import socket
import time
from dataclasses import dataclass, replace

import pytest
from pydrake.systems.analysis import Simulator

from splatpilot.systems.messaging.receiver import Received, Receiver, UdpConfig, UdpInbox


@dataclass(frozen=True, eq=False, kw_only=True)
class _Numbers(Received):
    numbers: tuple[int, ...] = ()


class Line(Receiver[_Numbers]):
    def __init__(self):
        super().__init__(_Numbers(), "the line", 0.01)
        self.messages, self.strangers = [], 0

    def _receive(self, context, received):
        def read(received: _Numbers, message: bytes) -> _Numbers:
            return replace(received, numbers=(*received.numbers, int(message)))

        return self._take(received, self.messages, self.strangers, read)


def test_messages_are_taken_or_counted(caplog):
    line = Line()
    simulator = Simulator(line)
    context = simulator.get_mutable_context()
    line.messages, line.strangers = [b"1", b"x", b"2"], 2
    simulator.AdvanceTo(0.0001)
    assert context.get_abstract_state(0).get_value().numbers == (1, 2)
    assert line.GetOutputPort("rejected").Eval(context)[0] == 3
    line.messages, line.strangers = [b"y"], 0
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        simulator.AdvanceTo(0.1401)
    assert line.GetOutputPort("rejected").Eval(context)[0] == 17
    assert [record.args[1] for record in caplog.records] == [4, 8, 16]
    assert "the line: message rejected, 4 so far: invalid literal" in caplog.text


def test_contexts_share_what_has_come():
    received = _Numbers(numbers=(1,))
    assert copy.deepcopy(received) is received


def send(inbox: UdpInbox, data: bytes, sender: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind((sender, 0))
        out.sendto(data, ("127.0.0.1", inbox.port))


def test_strangers_are_dropped_and_counted():
    inbox = UdpInbox(UdpConfig(port=0, senders=["127.0.0.1", "127.0.0.3"]))
    for data, last in ((b"a", 1), (b"b", 2), (b"c", 3), (b"d", 2), (b"", 1)):
        send(inbox, data, f"127.0.0.{last}")
    time.sleep(0.05)
    assert inbox.receive() == ([b"a", b"c", b""], 2)
    assert inbox.receive() == ([], 0)
    inbox.close()


def test_the_network_is_not_listened_to_unless_told():
    assert UdpConfig().host == "127.0.0.1" and UdpConfig().senders == ["127.0.0.1"]
    inbox = UdpInbox(UdpConfig(port=0))
    with pytest.raises(OSError, match=rf"127.0.0.1:{inbox.port}: Address already in use"):
        UdpInbox(UdpConfig(port=inbox.port))
    inbox.close()
    with pytest.raises(OSError, match="use another port, or an address of this host"):
        UdpInbox(UdpConfig(host="192.0.2.1", port=0))


@pytest.mark.parametrize(
    ("config", "why"),
    [
        (UdpConfig(senders=["drone"]), r"senders must be an IPv4 address.*, got \['drone'\]"),
        (UdpConfig(senders=[]), r"senders must be a list of at least one address"),
        (UdpConfig(host=""), "host must be an IPv4 address"),
        (UdpConfig(port=70000), r"port must be in \[0, 65535\], got 70000"),
    ],
)
def test_bad_config_is_named(config, why):
    with pytest.raises(ValueError, match=why):
        config.validate()
