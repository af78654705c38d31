"""Messages to and from PX4, read and written by pymavlink's own end; frames against other
implementations of rotations."""

import math
import re

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect
from pymavlink.quaternion import Quaternion
from pymavlink.rotmat import Vector3
from scipy.spatial.transform import Rotation

from splatpilot.systems.px4 import mavlink
from splatpilot.systems.px4.mavlink import pose_from_optitrack, swap_px4

OURS = mavlink.Mavlink()
PX4 = dialect.MAVLink(None, 1, 1)


def received(packet: bytes):
    """The one message in a packet."""
    (message,) = dialect.MAVLink(None).parse_buffer(packet) or []
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
    return message


def sent(*messages) -> bytes:
    return b"".join(bytes(message.pack(PX4)) for message in messages)


def mask(prefix: str, *names: str) -> int:
    return sum(getattr(dialect, f"{prefix}_{name}_IGNORE") for name in names)


def test_velocity_setpoint_is_in_the_local_frame():
    message = received(OURS.velocity_setpoint(np.array([1.0, 2.0, 3.0, math.nan]), 2.5))
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == (1.0, -2.0, -3.0, 0.0)
    assert message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
    prefix, ignored = "POSITION_TARGET_TYPEMASK", ("X", "Y", "Z", "AX", "AY", "AZ")
    assert message.type_mask == mask(prefix, *ignored, "YAW") == 1479
    assert message.time_boot_ms == 2500
    message = received(OURS.velocity_setpoint(np.array([0.0, 0.0, 0.0, 0.5]), 2.5))
    assert message.type_mask == mask(prefix, *ignored, "YAW_RATE") == 2503
    assert message.yaw == -0.5


@pytest.mark.parametrize(
    ("thrust", "px4"), [(9.81, 0.375), (19.62, 0.75), (99.0, 1.0), (-1.0, 0.0)]
)
def test_body_rates_have_thrust_from_0_to_1(thrust, px4):
    message = received(OURS.body_rates(np.array([thrust, 0.5, 0.25, -0.125]), 0.375, 9.81, 0.0))
    rates = message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate
    assert (*rates, message.thrust) == (0.5, -0.25, 0.125, px4)
    assert message.type_mask == mask("ATTITUDE_TARGET_TYPEMASK", "ATTITUDE") == 128


def test_odometry_is_that_of_ekf2():
    q_WB = np.array([0.5, 0.5, 0.5, -0.5])
    message = received(OURS.odometry(np.array([1.0, 2.0, 3.0, *q_WB]), 1_800_000_000_000_000))
    assert message.frame_id == dialect.MAV_FRAME_LOCAL_FRD
    assert message.child_frame_id == dialect.MAV_FRAME_BODY_FRD
    assert (message.x, message.y, message.z, *message.q) == (1, -2, -3, 0.5, 0.5, -0.5, 0.5)
    assert math.isnan(message.vx) and math.isnan(message.pose_covariance[0])
    assert message.time_usec == 1_800_000_000_000_000
    assert message.estimator_type == dialect.MAV_ESTIMATOR_TYPE_VISION  # EKF2 reads no MOCAP.


def test_requests_are_those_of_px4():
    for mode in (mavlink.OFFBOARD, mavlink.HOLD):
        message = received(OURS.set_mode(mode))
        assert message.command == dialect.MAV_CMD_DO_SET_MODE
        assert (message.param1, message.param2, message.param3) == (1.0, *mode)
    message = received(OURS.arm())
    assert message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM
    assert (message.param1, message.param2) == (1.0, 0.0)  # Not by force.
    assert received(OURS.heartbeat()).type == dialect.MAV_TYPE_ONBOARD_CONTROLLER


def test_px4s_estimates_are_in_our_frames():
    packet = sent(
        dialect.MAVLink_heartbeat_message(2, 12, 128 | 1, 6 << 16, 4, 3),
        dialect.MAVLink_local_position_ned_message(2500, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125),
        dialect.MAVLink_attitude_quaternion_message(2250, 0.5, 0.5, -0.5, 0.5, 0.1, 0.2, 0.3),
        dialect.MAVLink_system_time_message(0, 0),
    )
    other = mavlink.Mavlink(255).heartbeat()
    (heartbeat, position, attitude), refused = OURS.read(packet + other)
    assert heartbeat == mavlink.Heartbeat(True, mavlink.OFFBOARD)
    assert isinstance(position, mavlink.Position) and isinstance(attitude, mavlink.Attitude)
    assert (position.time, attitude.time, refused) == (2.5, 2.25, [])
    np.testing.assert_array_equal(position.p_WB, [1, -2, 3])
    np.testing.assert_array_equal(position.v_WB, [0.5, -0.25, 0.125])
    np.testing.assert_array_equal(attitude.q_WB, [0.5, 0.5, 0.5, -0.5])
    np.testing.assert_allclose(attitude.w_WB_B, [0.1, -0.2, -0.3], rtol=1e-6)


HEARTBEAT = dialect.MAVLink_heartbeat_message(2, 12, 1, 3 << 16, 4, 3)
GOOD = sent(HEARTBEAT)
NAN = dialect.MAVLink_local_position_ned_message(0, math.nan, 0, 0, 0, 0, 0)
LONG = dialect.MAVLink_attitude_quaternion_message(0, 2.0, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("packet", "why"),
    [
        (GOOD + b"LC02", "must be MAVLink"),
        (b"LC02" + GOOD, "must be MAVLink"),
        (GOOD + GOOD[:-1], "must end with a whole message"),
        (GOOD + GOOD[:15] + b"!" + GOOD[16:], "must be MAVLink"),
        (sent(NAN, HEARTBEAT), r"LOCAL_POSITION_NED: values must be finite, got \[nan"),
        (sent(HEARTBEAT, LONG), "ATTITUDE_QUATERNION: the attitude must be a unit quaternion"),
    ],
)
def test_an_invalid_message_hides_no_other(packet, why):
    messages, refused = OURS.read(packet)
    assert messages == [mavlink.Heartbeat(False, (3, 0))]
    assert len(refused) == 1 and re.search(why, refused[0])
    for garbage in (b"LC02", GOOD[:-1], np.random.default_rng(0).bytes(300)):
        messages, refused = OURS.read(garbage)
        assert not messages and refused


NED_FROM_W = Rotation.from_euler("x", 180, degrees=True)
W_FROM_O = Rotation.from_euler("x", 90, degrees=True)
ATTITUDES = Rotation.random(20, random_state=0)
VECTORS = np.random.default_rng(0).normal(size=(10, 3))


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def assert_same_attitude(q: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(q * np.sign(q.dot(expected)), expected, atol=1e-12)


def test_vectors_are_rotated_as_scipy_rotates_them():
    for v in VECTORS:
        np.testing.assert_allclose(swap_px4(v), NED_FROM_W.apply(v), atol=1e-12)
        np.testing.assert_array_equal(swap_px4(swap_px4(v)), v)
    np.testing.assert_array_equal(swap_px4(np.array([1.0, 2.0, 3.0])), [1, -2, -3])


def test_attitudes_are_those_of_scipy_and_of_pymavlink():
    for R_WB in ATTITUDES:
        q = swap_px4(wxyz(R_WB))
        assert_same_attitude(q, wxyz(NED_FROM_W * R_WB * NED_FROM_W.inv()))
        dcm = Quaternion(q).dcm
        forward, left = R_WB.apply([1.0, 0, 0]), R_WB.apply([0.0, 1, 0])
        for axis, ours in ((Vector3(1, 0, 0), forward), (Vector3(0, 1, 0), -left)):
            pointed = dcm * axis
            found = [pointed.x, pointed.y, pointed.z]
            np.testing.assert_allclose(found, NED_FROM_W.apply(ours), atol=1e-6)


def test_optitracks_poses_are_those_of_scipy_and_px4s_recipe():
    for R_OR, v in zip(ATTITUDES, np.vstack([VECTORS, VECTORS]), strict=True):
        pose = pose_from_optitrack(v, R_OR.as_quat())
        np.testing.assert_allclose(pose[:3], W_FROM_O.apply(v), atol=1e-12)
        assert_same_attitude(pose[3:], wxyz(W_FROM_O * R_OR * W_FROM_O.inv()))
        np.testing.assert_allclose(swap_px4(pose[:3]), [v[0], v[2], -v[1]])
        x, y, z, w = R_OR.as_quat()
        np.testing.assert_allclose(swap_px4(pose[3:]), [w, x, z, -y])
