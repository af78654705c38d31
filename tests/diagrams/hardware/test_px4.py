"""`splatpilot px4`, before anything flies."""

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
        (["--arm"], "px4.arm is asked for without px4.engage; give both"),
        (["--set", "motion_capture={}"], "px4.motion_capture has no px4.body"),
        (["--set", "udp.senders=[drone]"], "px4.udp.senders is 'drone'"),
        (["--set", "system=0"], "px4.system is 0"),
        (["--lcm-url", "tcp://there"], "must begin with udpm://"),
    ],
)
def test_bad_input_is_an_error_before_anything_is_sent(words, why, capsys):
    assert main(["px4", *words]) == 1
    assert why in capsys.readouterr().err


def test_a_port_that_is_taken_is_an_error(udp_url):
    inbox = UdpInbox(UdpConfig(port=0))
    with pytest.raises(OSError, match="Address already in use"):
        px4.run(config=Px4Config(url=udp_url, udp=UdpConfig(port=inbox.port)))
    inbox.close()
