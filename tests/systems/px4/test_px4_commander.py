"""What PX4 is told, and what it is not asked for."""

import socket
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pymavlink.dialects.v20 import common as dialect

from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.udp_inbox import UdpConfig, UdpInbox
from splatpilot.systems.px4.mavlink import LAND, OFFBOARD, Mavlink
from splatpilot.systems.px4.px4_commander import Px4Commander, Px4CommanderConfig


class Told:
    """A commander, and what it sends."""

    def __init__(self, config: Px4CommanderConfig, **inputs):
        self.px4 = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.px4.bind(("127.0.0.1", 0))
        self.px4.settimeout(0.0)
        self.inbox = UdpInbox(UdpConfig(port=0))
        self.system = Px4Commander(config, self.inbox, Mavlink(), self.px4.getsockname(), 9.81)
        self.simulator = Simulator(self.system)
        self.give(setpoint=[1.0, 0, 0, np.nan], setpoint_age=[0.0], armed=[0.0], mode=[3.0, 0.0])
        self.give(unix_time=[0.0], **inputs)
        self.simulator.Initialize()

    def give(self, **inputs) -> None:
        context = self.simulator.get_mutable_context()
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(context, value)

    def advance(self, duration: float) -> list:
        """What is sent meanwhile, heartbeats left out."""
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + duration)
        messages: list[Any] = []
        while True:
            try:
                packet = self.px4.recv(4096)
            except BlockingIOError:
                break
            messages += dialect.MAVLink(None).parse_buffer(packet) or []
        return [message for message in messages if message.get_type() != "HEARTBEAT"]

    def close(self) -> None:
        self.px4.close()
        self.inbox.close()


@pytest.fixture
def told():
    made = []

    def make(config: Px4CommanderConfig, **inputs) -> Told:
        made.append(Told(config, **inputs))
        return made[-1]

    yield make
    for each in made:
        each.close()


def modes(messages: list) -> list[tuple[float, float]]:
    return [
        (message.param2, message.param3)
        for message in messages
        if message.get_type() == "COMMAND_LONG" and message.command == 176
    ]


def test_setpoints_are_sent_at_50_hz_while_they_are_fresh(told):
    """Fifty a second, and none that is older than allowed."""
    vehicle = told(Px4CommanderConfig())
    assert len(vehicle.advance(1.0)) == pytest.approx(50, abs=1)
    vehicle.give(setpoint_age=[0.31])
    assert vehicle.advance(1.0) == []


def test_setpoints_are_sent_as_they_come(told):
    """One that comes between two of the fifty is sent within a tick, once, and by its own value;
    one that is old when it comes is not."""
    vehicle = told(Px4CommanderConfig())
    vehicle.advance(0.105)
    vehicle.give(setpoint_age=[0.012])
    assert vehicle.advance(0.002) == []
    vehicle.give(setpoint=[0.0, 2.0, 0, np.nan], setpoint_age=[0.001])
    sent = vehicle.advance(0.006)
    assert [(m.vx, m.vy) for m in sent] == [(0.0, -2.0)]
    vehicle.give(setpoint_age=[0.5])
    vehicle.advance(0.02)
    vehicle.give(setpoint_age=[0.4])
    assert vehicle.advance(0.05) == []


@pytest.mark.parametrize("mode", [status.WAITING, status.HOLDING, status.LANDING])
def test_offboard_mode_is_not_asked_for_unless_the_bridge_flies(told, mode):
    """While the bridge waits, holds or lands, nothing is engaged or armed."""
    config = Px4CommanderConfig(engage=True, arm=True)
    vehicle = told(config, bridge_mode=[float(mode)])
    assert modes(vehicle.advance(4.0)) == []
    vehicle.give(bridge_mode=[float(status.FLYING)])
    asked = modes(vehicle.advance(2.5))
    assert len(asked) == 3 and set(asked) == {OFFBOARD}


def test_arming_is_asked_for_in_offboard_mode_alone(told):
    """It follows offboard mode, once a second, and ends when PX4 is armed."""
    vehicle = told(Px4CommanderConfig(engage=True, arm=True))
    vehicle.advance(2.0)
    vehicle.give(mode=[6.0, 0.0])
    armed = [m.command for m in vehicle.advance(2.0) if m.get_type() == "COMMAND_LONG"]
    assert armed == [dialect.MAV_CMD_COMPONENT_ARM_DISARM] * 2
    vehicle.give(armed=[1.0])
    assert not [m for m in vehicle.advance(3.0) if m.get_type() == "COMMAND_LONG"]


def test_where_the_bridge_lands_px4_does(told):
    """PX4's own landing is asked for until it is entered, and no setpoint follows."""
    vehicle = told(Px4CommanderConfig(engage=True), bridge_mode=[float(status.FLYING)])
    vehicle.advance(2.0)
    vehicle.give(mode=[6.0, 0.0], armed=[1.0])
    vehicle.advance(0.5)
    vehicle.give(bridge_mode=[float(status.LANDING)])
    messages = vehicle.advance(2.0)
    assert set(modes(messages)) == {LAND}
    assert len(messages) == len(modes(messages)) == 2
    vehicle.give(mode=[4.0, 6.0], bridge_mode=[float(status.FLYING)])
    assert vehicle.advance(3.0) == []


@pytest.mark.parametrize(
    ("config", "why"),
    [
        (Px4CommanderConfig(setpoints="position"), r"px4\.setpoints is 'position'"),
        (Px4CommanderConfig(hover_thrust=0.0), r"px4\.hover_thrust is 0"),
        (Px4CommanderConfig(max_age=0.0), r"px4\.max_age is 0"),
        (Px4CommanderConfig(arm=True), r"px4\.arm is asked for without px4\.engage"),
    ],
)
def test_bad_config_is_named(config, why):
    """A value out of range names the field, and arming needs offboard mode."""
    with pytest.raises(ValueError, match=why):
        config.validate()
