"""Streams of time-of-flight sensors over UDP."""

import socket
import struct
import time

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from splatpilot.systems.messaging.tof_receiver import (
    TimeOfFlightReceiver,
    TimeOfFlightStream,
    UdpConfig,
)


def packet(value: float, seq: int, time_ns: int) -> bytes:
    return struct.pack("<IIQ144f", 0x544F4632, seq, time_ns, *[value] * 144)


class Sensor:
    """A receiver, and sockets that stream to it."""

    def __init__(self):
        config = TimeOfFlightStream(UdpConfig(port=0), latency=0.02)
        self.system = TimeOfFlightReceiver(config, 0.01)
        self.simulator = Simulator(self.system)
        self.simulator.Initialize()

    def send(self, data: bytes, sender: str = "127.0.0.1") -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.bind((sender, 0))
            out.sendto(data, ("127.0.0.1", self.system.port))
        time.sleep(0.005)

    def advance_to(self, now: float) -> None:
        self.simulator.AdvanceTo(now)

    def out(self, name: str) -> np.ndarray:
        return self.system.GetOutputPort(name).Eval(self.simulator.get_context()).copy()


def test_grid_and_its_age():
    sensor = Sensor()
    assert not sensor.out("depth_grid").any() and sensor.out("age")[0] == np.inf
    sensor.send(packet(0.25, 3, 100))
    assert sensor.system.has_message()
    sensor.advance_to(0.1)
    np.testing.assert_array_equal(sensor.out("depth_grid"), np.full(144, 0.25))
    # It was seen at the first look.
    assert sensor.out("age")[0] == pytest.approx(0.1 + 0.02, abs=0.011)
    sensor.send(packet(0.75, 6, 200))
    sensor.advance_to(0.4)
    np.testing.assert_array_equal(sensor.out("depth_grid"), np.full(144, 0.75))
    assert sensor.out("age")[0] == pytest.approx(0.3 + 0.02, abs=0.011)
    assert sensor.out("gaps")[0] == 2


def test_what_is_of_no_use_is_counted_and_harms_nothing(caplog):
    sensor = Sensor()
    sensor.send(packet(0.5, 1, 100))
    sensor.advance_to(0.05)
    for _ in range(5):
        sensor.send(packet(0.9, 2, 200)[:-1])
    sensor.send(packet(0.9, 2, 200), sender="127.0.0.2")
    sensor.send(packet(0.9, 0, 50))
    sensor.advance_to(0.1)
    np.testing.assert_array_equal(sensor.out("depth_grid"), np.full(144, 0.5))
    assert sensor.out("rejected")[0] == 7
    assert len(caplog.records) == 3
    assert "rejected, 4 so far: packet of a grid must be 592 bytes" in caplog.text


def test_a_sensor_that_starts_again_is_received_again():
    sensor = Sensor()
    sensor.send(packet(0.5, 90, 10**12))
    sensor.advance_to(0.1)
    sensor.send(packet(0.6, 0, 100))
    sensor.advance_to(0.5)
    assert sensor.out("depth_grid")[0] == 0.5
    sensor.advance_to(2.0)
    sensor.send(packet(0.75, 1, 200))
    sensor.advance_to(2.1)
    assert sensor.out("depth_grid")[0] == 0.75
    assert sensor.out("gaps")[0] == 0


def test_bad_config_is_named():
    with pytest.raises(ValueError, match=r"latency must be in \[0, 1\] s, got 2"):
        TimeOfFlightReceiver(TimeOfFlightStream(latency=2.0), 0.01)
    with pytest.raises(ValueError, match=r"port must be in .* got -1"):
        TimeOfFlightReceiver(TimeOfFlightStream(UdpConfig(port=-1)), 0.01)
