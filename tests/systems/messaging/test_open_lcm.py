"""Opening LCM."""

import os
import resource
import socket

import pytest

from splatpilot.systems.messaging.lcm_ports import open_lcm


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


def test_too_many_open_files_are_an_error_and_no_crash():
    """Beyond a thousand files LCM would overwrite its own stack."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limits[1] != resource.RLIM_INFINITY and limits[1] < 1100:
        pytest.skip(f"this process may open {limits[1]} files only")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limits[0], 1100), limits[1]))
    files = []
    try:
        while not files or files[-1] < 1000:
            files.append(os.open(os.devnull, os.O_RDONLY))
        with pytest.raises(OSError, match="files are open in this process, at most 1000"):
            open_lcm("memq://")
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
