import socket
import struct

import numpy as np
import pytest
from harness import Harness, natnet_frame
from scipy.spatial.transform import Rotation

from splatpilot.systems.messaging.receiver import UdpConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig, MotionCaptureReceiver

LATENCY = 0.02


class Stream(Harness):
    """A receiver, and the cameras that send to it."""

    def __init__(self, now=None, group: str = ""):
        udp = UdpConfig(port=0, group=group)
        config = MotionCaptureConfig(udp, body_id=3, version=[4, 0], latency=LATENCY)
        super().__init__(MotionCaptureReceiver(config, 0.01, now), unix_time=0.0)
        self.to, self.number = group or "127.0.0.1", 0

    def see(self, body=3, position=(1.0, 2.0, 3.0), q=(0, 0, 0, 1), tracked=True, number=None):
        self.number = self.number + 1 if number is None else number
        self.send(natnet_frame(self.number, body, position, q, tracked))

    def send(self, data: bytes, sender: str = "127.0.0.1") -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(sender))
            out.bind((sender, 0))
            out.sendto(data, (self.to, self.system.port))

    def after(self, duration: float) -> tuple[np.ndarray, float, float]:
        for _ in range(round(duration / 0.01)):
            self.simulator.AdvanceTo(self.now + 0.01)
            self.give(unix_time=self.now)
        return self.out("motion_capture_pose"), self.out("age"), self.out("rejected")


def test_pose_is_that_of_the_body_in_our_frames():
    stream = Stream()
    assert stream.after(0.0)[1] == np.inf
    stream.see(3, [1.0, 2.0, 3.0], Rotation.from_euler("y", 0.5).as_quat())  # about the vertical
    stream.see(4, [9.0, 9.0, 9.0])
    pose, age, rejected = stream.after(0.05)
    np.testing.assert_allclose(pose[:3], [1, -3, 2])
    expected = Rotation.from_euler("z", 0.5).as_quat(scalar_first=True)
    np.testing.assert_allclose(pose[3:], expected, atol=1e-6)
    assert age == pytest.approx(0.05 + LATENCY) and rejected == 0


@pytest.mark.parametrize(
    "seen",
    [
        *({"tracked": False}, {"body": 4}, None),
        *({"position": (np.nan, 2.0, 3.0)}, {"q": (0.0, 0.0, 0.0, 2.0)}),
    ],
)
def test_the_pose_of_a_body_that_is_not_seen_grows_old(seen):
    stream = Stream()
    stream.see()
    before, _, _ = stream.after(0.05)
    for _ in range(19):
        if seen is not None:
            stream.see(**seen)
        stream.after(0.01)
    pose, age, rejected = stream.after(0.01)
    np.testing.assert_array_equal(pose, before)
    assert age == pytest.approx(0.25 + LATENCY) and rejected == 0


def test_frames_that_are_not_newer_are_counted_unless_the_stream_starts_again():
    stream = Stream()
    stream.see(position=(5.0, 2.0, 3.0), number=1000)
    stream.after(0.1)
    for number in (1000, 999, 3):
        stream.see(number=number)
    pose, age, rejected = stream.after(0.1)
    assert (pose[0], rejected) == (5.0, 3)
    assert age == pytest.approx(0.2 + LATENCY)
    stream.after(0.9)
    stream.see(position=(7.0, 2.0, 3.0), number=1)
    pose, age, rejected = stream.after(0.02)
    assert (pose[0], rejected) == (7.0, 3)
    assert age == pytest.approx(0.02 + LATENCY)


def test_invalid_packets_are_counted(caplog):
    stream = Stream()
    good = natnet_frame(1, 3, [1.0, 2.0, 3.0], [0, 0, 0, 1])
    stream.send(good)
    before, _, _ = stream.after(0.02)
    cut = good[:40]
    for data in (good[:-1], struct.pack("<HH", 7, len(cut) - 4) + cut[4:], b"", b"x" * 7):
        stream.send(data)
    stream.send(natnet_frame(2, 3, [7.0, 7.0, 7.0], [0, 0, 0, 1]), sender="127.0.0.9")
    pose, _, rejected = stream.after(0.02)
    np.testing.assert_array_equal(pose, before)
    assert rejected == 5
    assert "motion capture: message rejected, 1 so far" in caplog.text


def test_a_multicast_group_is_joined_and_the_time_of_reading_counts():
    stream = Stream(now=lambda: 0.01, group="239.255.42.199")  # The wall clock is ahead.
    stream.see()
    pose, age, _ = stream.after(0.05)
    np.testing.assert_allclose(pose[:3], [1, -3, 2])
    assert age == pytest.approx(0.04 + LATENCY)
