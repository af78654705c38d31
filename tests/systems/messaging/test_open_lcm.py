"""Opening LCM."""

import socket

import pytest

from splatpilot.systems.messaging.open_lcm import open_lcm


def test_opens(udp_url):
    """A group and port of LCM's own, and memory, are opened."""
    for url in (udp_url, "memq://"):
        open_lcm(url)


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("nonsense://", "must begin with udpm:// or memq://"),
        ("", "must begin with"),
        ("file:///tmp/flight.lcm", "must begin with"),
        ("udpm://1.2.3.4:7667", "use a multicast group"),
        ("udpm://not.an.address:7667", "use a multicast group"),
    ],
)
def test_urls_of_no_use_are_refused(url, reason):
    """A URL that LCM does not have is an error with the remedy."""
    with pytest.raises(OSError, match=reason):
        open_lcm(url)


def test_port_in_use_is_refused(udp_url):
    """A port that another program holds is an error before anything flies."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        url = f"udpm://239.255.76.67:{other.getsockname()[1]}?ttl=0"
        with pytest.raises(OSError, match="does not deliver its own messages; use a multicast"):
            open_lcm(url)
