"""`splatpilot hardware px4`, before anything flies."""

import re

import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.hardware import px4
from splatpilot.diagrams.hardware.px4 import Px4Config
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox


def test_it_says_what_it_will_not_do(udp_url, capsys):
    px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=0)), duration=0.1)
    said = capsys.readouterr().out
    assert "Offboard mode is left to the pilot." in said
    assert "Arming is left to the pilot." in said


def test_it_counts_how_long_there_is_no_heartbeat(udp_url, capsys, monkeypatch):
    monkeypatch.setattr(px4, "REMINDER", 0.1)
    px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=0)), duration=0.35)
    said = re.findall(
        r"no heartbeat for (\S+) s at 127\.0\.0\.1:\d+$", capsys.readouterr().out, re.M
    )
    assert said == ["0.1", "0.2", "0.3"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--arm"], "arm must be false without engage"),
        (["--set", "motion_capture={}"], "body must be a name, which motion_capture needs"),
        (["--set", "udp.senders=[drone]"], "senders must be an IPv4 address"),
        (["--set", "system=0"], "system must be in [1, 255], got 0"),
        (["--lcm-url", "tcp://there"], "must begin with udpm://"),
    ],
)
def test_bad_input_is_an_error_before_anything_is_sent(words, why, capsys):
    assert main(["hardware", "px4", *words]) == 1
    assert why in capsys.readouterr().err


def test_a_port_that_is_taken_is_an_error(udp_url):
    inbox = UdpInbox(UdpConfig(port=0))
    with pytest.raises(OSError, match="Address already in use"):
        px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=inbox.port)))
    inbox.close()
