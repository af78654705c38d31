"""OptiTrack's stream, written here byte by byte and read by `natnet`."""

import socket
import struct
import time

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from splatpilot.systems.messaging.udp_inbox import UdpConfig
from splatpilot.systems.px4.motion_capture_receiver import (
    MotionCaptureConfig,
    MotionCaptureReceiver,
)


def frame(body: int, position, q_xyzw, tracked: bool = True) -> bytes:
    """A frame of NatNet 4.0: no markers, one rigid body, nothing else."""
    data = struct.pack("<III", 17, 0, 0)  # number, marker sets, other markers
    data += struct.pack("<Ii7ff", 1, body, *position, *q_xyzw, 0.001) + struct.pack("<H", tracked)
    data += struct.pack("<IIII", 0, 0, 0, 0)  # skeletons, markers, force plates, devices
    data += struct.pack("<IIdQQQH", 0, 0, 1.25, 0, 0, 0, 0)
    data += struct.pack("<I", 0)
    return struct.pack("<HH", 7, len(data)) + data


class Camera:
    """A receiver, and who sends to it."""

    def __init__(self, udp: UdpConfig):
        config = MotionCaptureConfig(udp, body_id=3, version=[4, 0])
        self.system = MotionCaptureReceiver(config, 0.01)
        self.simulator = Simulator(self.system)
        self.simulator.Initialize()

    def send(self, data: bytes, to: str = "127.0.0.1", sender: str = "127.0.0.1") -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(sender))
            out.bind((sender, 0))
            out.sendto(data, (to, self.system.port))
        time.sleep(0.01)

    def after(self, duration: float) -> tuple[np.ndarray, float, float]:
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + duration)
        context = self.simulator.get_context()
        names = "motion_capture_pose", "age", "rejected"
        pose, age, rejected = (self.system.GetOutputPort(n).Eval(context).copy() for n in names)
        return pose, age[0], rejected[0]


def test_pose_is_that_of_the_body_in_our_frames():
    """Of the named body position and attitude are turned from y up to z up; others are none of our
    business; a body that is not seen has no pose, and grows old."""
    stream = Camera(UdpConfig(port=0))
    assert stream.after(0.0)[1] == np.inf
    turn = Rotation.from_euler("y", 0.5)  # about the vertical
    stream.send(frame(3, [1.0, 2.0, 3.0], turn.as_quat()))
    stream.send(frame(4, [9.0, 9.0, 9.0], [0, 0, 0, 1]))
    pose, age, rejected = stream.after(0.05)
    np.testing.assert_allclose(pose[:3], [1, -3, 2])
    expected = Rotation.from_euler("z", 0.5).as_quat()
    np.testing.assert_allclose(pose[3:], np.roll(expected, 1), atol=1e-6)
    assert age <= 0.05 and rejected == 0
    stream.send(frame(3, [0.0, 0.0, 0.0], [0, 0, 0, 1], tracked=False))
    pose, age, rejected = stream.after(0.2)
    assert np.isnan(pose).all() and 0.2 <= age <= 0.26 and rejected == 0


def test_what_is_no_frame_is_counted(caplog):
    """Frames that are cut, random bytes and strangers' frames are refused, and change nothing."""
    stream = Camera(UdpConfig(port=0))
    good = frame(3, [1.0, 2.0, 3.0], [0, 0, 0, 1])
    stream.send(good)
    before, _, _ = stream.after(0.02)
    cut = good[:40]
    for data in (good[:-1], struct.pack("<HH", 7, len(cut) - 4) + cut[4:], b"", b"x" * 7):
        stream.send(data)
    stream.send(frame(3, [7.0, 7.0, 7.0], [0, 0, 0, 1]), sender="127.0.0.9")
    pose, _, rejected = stream.after(0.02)
    np.testing.assert_array_equal(pose, before)
    assert rejected == 5
    assert "motion capture: a message is refused, 1 so far" in caplog.text


def test_a_multicast_group_is_joined_where_one_is_named():
    """What is sent to the group arrives."""
    stream = Camera(UdpConfig(port=0, group="239.255.42.199"))
    stream.send(frame(3, [1.0, 2.0, 3.0], [0, 0, 0, 1]), to="239.255.42.199")
    pose, _, _ = stream.after(0.02)
    np.testing.assert_allclose(pose[:3], [1, -3, 2])


def test_bad_config_is_named():
    """A value out of range names the field."""
    with pytest.raises(ValueError, match=r"motion_capture\.version is \[1, 0\]"):
        MotionCaptureConfig(version=[1, 0]).validate()
    with pytest.raises(ValueError, match=r"motion_capture\.udp\.group is '10.0.0.1'"):
        MotionCaptureConfig(UdpConfig(group="10.0.0.1")).validate()
