import socket
import struct

import numpy as np
import pytest
from harness import Harness

from splatpilot.systems.messaging import receiver


def send(port: int, data: bytes, sender: str = "127.0.0.1") -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind((sender, 0))
        out.sendto(data, ("127.0.0.1", port))


def test_strangers_are_dropped_and_counted():
    inbox = receiver.UdpInbox(receiver.UdpConfig(port=0, senders=["127.0.0.1", "127.0.0.3"]))
    for data, last in ((b"a", 1), (b"b", 2), (b"c", 3), (b"d", 2), (b"", 1)):
        send(inbox.port, data, f"127.0.0.{last}")
    assert inbox.receive() == ([b"a", b"c", b""], 2)
    assert inbox.receive() == ([], 0)
    inbox.close()


def test_a_port_in_use_and_an_address_of_another_host_are_refused():
    config = receiver.UdpConfig()
    assert (config.host, config.senders) == ("127.0.0.1", ["127.0.0.1"])
    inbox = receiver.UdpInbox(receiver.UdpConfig(port=0))
    with pytest.raises(OSError, match=rf"127.0.0.1:{inbox.port}: Address already in use"):
        receiver.UdpInbox(receiver.UdpConfig(port=inbox.port))
    inbox.close()
    with pytest.raises(OSError, match="an address of this host"):
        receiver.UdpInbox(receiver.UdpConfig(host="192.0.2.1", port=0))


def packet(value: float, seq: int, time_ns: int) -> bytes:
    return struct.pack("<IIQ144f", 0x544F4632, seq, time_ns, *[value] * 144)


class Sensor(Harness):
    """A receiver of a sensor's stream."""

    def __init__(self):
        config = receiver.TimeOfFlightStream(receiver.UdpConfig(port=0), latency=0.02)
        super().__init__(receiver.TimeOfFlightReceiver(config, 0.01))

    def after(self, now: float, *packets: bytes) -> tuple[float, float, float, float]:
        """The value of the grid, its age, gaps and rejected packets at a time."""
        for data in packets:
            send(self.system.port, data)
        self.simulator.AdvanceTo(now)
        grid = self.out("depth_grid")
        assert grid.shape == (144,) and np.ptp(grid) == 0.0
        return grid[0], self.out("age"), self.out("gaps"), self.out("rejected")


def test_grid_and_its_age():
    sensor = Sensor()
    assert sensor.after(0.0) == (0.0, np.inf, 0, 0)
    send(sensor.system.port, packet(0.25, 3, 100))
    assert sensor.system.has_message()
    assert sensor.after(0.1) == pytest.approx((0.25, 0.1 + 0.02, 0, 0), abs=0.011)
    assert sensor.after(0.4, packet(0.75, 6, 200)) == pytest.approx((0.75, 0.32, 2, 0), abs=0.011)


def test_invalid_packets_change_nothing(caplog):
    sensor = Sensor()
    sensor.after(0.05, packet(0.5, 1, 100))
    send(sensor.system.port, packet(0.9, 2, 200), sender="127.0.0.2")
    value, _, gaps, rejected = sensor.after(
        0.1, packet(0.9, 0, 50), *[packet(0.9, 2, 200)[:-1]] * 5
    )
    assert (value, gaps, rejected) == (0.5, 0, 7)
    assert [record.args[1] for record in caplog.records] == [1, 2, 4]  # Reasons of ever fewer.
    assert "rejected, 4 so far: packet of a grid must be 592 bytes" in caplog.text


def test_a_sensor_that_starts_again_is_received_again():
    sensor = Sensor()
    sensor.after(0.1, packet(0.5, 90, 10**12))
    assert sensor.after(0.5, packet(0.6, 0, 100))[0] == 0.5
    sensor.after(2.0)
    value, _, gaps, _ = sensor.after(2.1, packet(0.75, 1, 200))
    assert (value, gaps) == (0.75, 0)
