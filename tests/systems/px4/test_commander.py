import numpy as np
import pytest
from harness import Harness, Packets
from pymavlink.dialects.v20 import common as dialect

from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.px4.commander import Px4Commander, Px4CommanderConfig
from splatpilot.systems.px4.mavlink import HOLD, LAND, OFFBOARD, Mavlink

TICK, UNIX_TIME = 0.002, 1_800_000_000.0  # [s] The latter is that of time 0.


class Told(Harness):
    """A commander, and the messages that it sends. A setpoint of age 0 is one of a 50 Hz stream."""

    def __init__(self, config: Px4CommanderConfig | None = None, **inputs):
        self.packets, config = Packets(), config or Px4CommanderConfig()
        system = Px4Commander(config, self.packets, Mavlink(), ("127.0.0.1", 9), 9.81)
        given = {"setpoint": [1.0, 0, 0, np.nan], "setpoint_age": 0.0, "armed": 0.0}
        given |= {"mode": [3.0, 0.0], "heartbeat_age": 0.0, "granted": [0.0, 0.0]}
        super().__init__(system, **given | {"unix_time": UNIX_TIME} | inputs)

    def give(self, **inputs) -> None:
        super().give(**inputs)
        if "setpoint_age" in inputs:
            self.sent = self.now - inputs["setpoint_age"]
            self.is_stream = self.sent == self.now

    def advance(self, duration: float) -> list:
        """Returns the messages that are sent meanwhile, without heartbeats."""
        for tick in range(round(self.now / TICK), round((self.now + duration) / TICK)):
            if self.is_stream and tick % 10 == 0:
                self.sent = tick * TICK
            super().give(setpoint_age=tick * TICK - self.sent, unix_time=UNIX_TIME + tick * TICK)
            self.simulator.AdvanceTo((tick + 1) * TICK)
        return [each for each in self.packets.take_sent() if each.get_type() != "HEARTBEAT"]

    def advance_without_heartbeats(self, first_age: float, until: float) -> list:
        """Returns the messages that are sent while the last heartbeat ages."""
        messages = []
        for age in np.arange(first_age, until, 0.02):
            self.give(heartbeat_age=age)
            messages += self.advance(0.02)
        return messages


def requests(messages: list) -> list[int]:
    return [m.command for m in messages if m.get_type() == "COMMAND_LONG"]


def modes(messages: list) -> list[tuple[float, float]]:
    commands = [m for m in messages if m.get_type() == "COMMAND_LONG" and m.command == 176]
    return [(command.param2, command.param3) for command in commands]


def setpoints(messages: list) -> list[tuple[float, float, float]]:
    kind = "SET_POSITION_TARGET_LOCAL_NED"
    return [(m.vx, m.vy, m.vz) for m in messages if m.get_type() == kind]


def test_setpoints_are_sent_at_50_hz_while_they_are_fresh():
    vehicle = Told()  # By default nothing else is sent, and nothing arms.
    sent = vehicle.advance(3.0)
    assert len(sent) == pytest.approx(150, abs=1) and len(setpoints(sent)) == len(sent)
    vehicle.give(setpoint_age=0.31)
    assert vehicle.advance(1.0) == []


def test_setpoints_are_sent_as_they_come():
    vehicle = Told()
    vehicle.advance(0.105)
    vehicle.give(setpoint_age=0.012)
    assert vehicle.advance(0.002) == []
    vehicle.give(setpoint=[0.0, 2.0, 0, np.nan], setpoint_age=0.001)
    sent = vehicle.advance(0.006)
    assert [(m.vx, m.vy) for m in sent] == [(0.0, -2.0)]
    vehicle.give(setpoint_age=0.5)
    vehicle.advance(0.02)
    vehicle.give(setpoint_age=0.4)
    assert vehicle.advance(0.05) == []


@pytest.mark.parametrize("mode", [status.WAITING, status.HOLDING, status.LANDING])
def test_offboard_mode_is_requested_only_while_the_bridge_flies(mode):
    config = Px4CommanderConfig(engage=True, arm=True)
    vehicle = Told(config, bridge_mode=float(mode))
    assert modes(vehicle.advance(4.0)) == []
    vehicle.give(bridge_mode=float(status.FLYING))
    asked = modes(vehicle.advance(2.5))
    assert len(asked) == 3 and set(asked) == {OFFBOARD}


def test_arming_is_requested_only_in_offboard_mode():
    vehicle = Told(Px4CommanderConfig(engage=True, arm=True))
    vehicle.advance(2.0)
    vehicle.give(mode=[6.0, 0.0])
    assert requests(vehicle.advance(2.0)) == [dialect.MAV_CMD_COMPONENT_ARM_DISARM] * 2
    vehicle.give(armed=1.0)
    assert requests(vehicle.advance(3.0)) == []


FLYING = {"bridge_mode": float(status.FLYING), "mode": [6.0, 0.0], "armed": 1.0}
LOST = {"setpoint_age": 0.31}
LANDS = {"bridge_mode": float(status.LANDING)}


@pytest.mark.parametrize(("loss", "mode"), [(LOST, HOLD), (LANDS, LAND)])
def test_a_mode_is_requested_after_a_heartbeat_that_is_newer_than_the_loss(loss, mode):
    vehicle = Told(Px4CommanderConfig(engage=True, arm=True), **FLYING)
    vehicle.advance(1.0)
    vehicle.give(**loss)
    for silence in (0.9, 1.5):
        assert modes(vehicle.advance_without_heartbeats(0.02, silence)) == []
        vehicle.give(heartbeat_age=0.0)
        assert modes(vehicle.advance(0.04)) == [mode]
    assert vehicle.out("ended") == 1.0
    vehicle.give(mode=list(mode), bridge_mode=float(status.FLYING), setpoint_age=0.0)
    assert vehicle.advance(3.0) == []


@pytest.mark.parametrize(("interface", "age"), [("velocity", 0.31), ("body_rates", 0.11)])
def test_until_then_the_vehicle_is_told_to_stop(interface, age):
    vehicle = Told(Px4CommanderConfig(setpoints=interface), **FLYING)
    vehicle.advance(1.0)
    vehicle.give(setpoint_age=age)
    sent = vehicle.advance_without_heartbeats(0.02, 3.0)
    assert set(setpoints(sent)) == {(0.0, 0.0, 0.0)}
    assert len(sent) == pytest.approx(100, abs=2)


def test_a_bridge_that_comes_back_in_time_flies_on():
    vehicle = Told(**FLYING)
    vehicle.advance(1.0)
    vehicle.give(heartbeat_age=0.5, **LOST)
    vehicle.advance(0.1)
    vehicle.give(setpoint_age=0.0)
    vehicle.advance(0.02)
    vehicle.give(heartbeat_age=0.0)
    sent = vehicle.advance(1.0)
    assert modes(sent) == [] and set(setpoints(sent)) == {(1.0, 0.0, 0.0)}


@pytest.mark.parametrize("loss", [{}, LOST, LANDS])
def test_without_heartbeats_nothing_is_requested(loss):
    vehicle = Told(Px4CommanderConfig(engage=True, arm=True), **FLYING)
    vehicle.advance(2.0)
    vehicle.give(heartbeat_age=3.1, mode=[0.0, 0.0], armed=0.0, **loss)
    sent = vehicle.advance(3.0)
    assert requests(sent) == []
    assert len(setpoints(sent)) >= 100


@pytest.mark.parametrize(
    ("mode", "granted", "command"), [(3.0, [1.0, 0.0], 176), (6.0, [1.0, 1.0], 400)]
)
def test_a_granted_request_is_not_repeated(mode, granted, command):
    vehicle = Told(Px4CommanderConfig(engage=True, arm=True), mode=[mode, 0.0])
    assert requests(vehicle.advance(1.6)) == [command]
    vehicle.give(granted=granted)
    assert requests(vehicle.advance(3.0)) == []


@pytest.mark.parametrize(("interval", "sent"), [(0.005, 50), (1 / 120, 40), (0.02, 50), (0.1, 10)])
def test_poses_are_sent_once_as_they_come_at_50_hz_at_most(interval, sent):
    vehicle = Told(motion_capture_age=0.31, motion_capture_pose=[1.0, 2, 3, 1, 0, 0, 0])
    assert "ODOMETRY" not in [m.get_type() for m in vehicle.advance(0.1)]  # It is too old.
    messages, start = [], vehicle.now
    for tick in range(500):
        now, seen = 0.002 * tick, interval * np.floor(0.002 * tick / interval + 1e-6)
        vehicle.give(motion_capture_pose=[seen, 2, 3, 1, 0, 0, 0])
        vehicle.give(motion_capture_age=now - seen + 0.01)
        messages += vehicle.advance(0.002)
    poses = [m for m in messages if m.get_type() == "ODOMETRY"]
    assert len(poses) == pytest.approx(sent, abs=1)
    times = np.array([m.time_usec for m in poses]) * 1e-6 - UNIX_TIME - start
    np.testing.assert_allclose(times, [m.x - 0.01 for m in poses], atol=0.0021)
    assert (np.diff(times) > 1e-4).all() and not np.isnan([m.x for m in poses]).any()
