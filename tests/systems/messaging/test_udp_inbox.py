"""Sockets that hear only whom they are told to."""

import socket
import time

import pytest

from splatpilot.systems.messaging.tof_receiver import UdpConfig, UdpInbox


def send(inbox: UdpInbox, data: bytes, sender: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind((sender, 0))
        out.sendto(data, ("127.0.0.1", inbox.port))


def test_strangers_are_dropped_and_counted():
    """Of packets in a row those of the senders that are named are left, in order."""
    inbox = UdpInbox(UdpConfig(port=0, senders=["127.0.0.1", "127.0.0.3"]))
    for data, last in ((b"a", 1), (b"b", 2), (b"c", 3), (b"d", 2), (b"", 1)):
        send(inbox, data, f"127.0.0.{last}")
    time.sleep(0.05)
    assert inbox.receive() == ([b"a", b"c", b""], 2)
    assert inbox.receive() == ([], 0)
    inbox.close()


def test_the_network_is_not_listened_to_unless_told():
    """By default packets come to the loopback alone, and from it; a port in use and an address of
    another host are errors with the remedy."""
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
        (UdpConfig(senders=["drone"]), r"x\.senders is 'drone'; it must be an IPv4 address"),
        (UdpConfig(senders=[]), r"x\.senders is empty"),
        (UdpConfig(host=""), r"x\.host is ''"),
        (UdpConfig(port=70000), r"x\.port is 70000"),
    ],
)
def test_bad_config_is_named(config, why):
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=why):
        config.validate("x")
