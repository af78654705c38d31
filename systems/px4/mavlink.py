"""Mavlink: messages to and from PX4, in our frames; no other module converts frames.

Ours are the world W, z up, and the body B: x forward, y left, z up. PX4's are its local frame, x
north, y east, z down, and the body x forward, y right, z down. W is the local frame rotated by half
a turn about its x axis: x north, y west. OptiTrack's world and bodies, y up: x north, y up, z east.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.messaging.codecs import finite, require_unit_quaternion


def swap_px4(v: np.ndarray) -> np.ndarray:
    """Converts a vector (3,) between W or B and PX4's local or body frame, or an attitude (4, wxyz)
    between W and the local frame, in either direction."""
    return np.append(v[:-2], -v[-2:])


def pose_from_optitrack(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Converts a position p (3,) and an attitude q (4, xyzw) of OptiTrack to (p_WB, q_WB) (7,)."""
    (x, y, z), (qx, qy, qz, qw) = p, q
    return np.array([x, -z, y, qw, qx, -qz, qy])


_ONBOARD_COMPUTER = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
CUSTOM_MODE, ARMED = 1, 128  # MAV_MODE_FLAGs
_RESULTS = "ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS"
_WARNING = 4  # MAV_SEVERITY_WARNING; more severe ones are smaller.
SET_MODE, ARM = 176, 400  # Commands: MAV_CMD_DO_SET_MODE and MAV_CMD_COMPONENT_ARM_DISARM.
VELOCITY_AND_YAW_RATE, VELOCITY_AND_YAW, BODY_RATES = 1479, 2503, 128
"""Type masks of setpoints: fields that PX4 ignores."""

OFFBOARD, HOLD, LAND = (6, 0), (4, 3), (4, 6)  # PX4's main and sub modes.


class Heartbeat(NamedTuple):
    """PX4's mode."""

    armed: bool
    mode: tuple[int, int]  # main and sub mode


class Position(NamedTuple):
    """Position and velocity that PX4 estimates."""

    time: float  # [s] since PX4 began.
    p_WB: np.ndarray  # (3,) [m]
    v_WB: np.ndarray  # (3,) [m/s]


class Attitude(NamedTuple):
    """Attitude and body rates that PX4 estimates."""

    time: float  # [s] since PX4 began.
    q_WB: np.ndarray  # (4, wxyz)
    w_WB_B: np.ndarray  # (3,) [rad/s]


class Timesync(NamedTuple):
    """A request for the time, or an answer."""

    answer: int  # [ns] by the clock of the one that answers; 0 in a request.
    question: int  # [ns] by the clock of the one that asks.


class Granted(NamedTuple):
    """Acceptance of a command of ours."""

    command: int


class Notice(NamedTuple):
    """A warning of PX4, or its refusal of a command of ours."""

    text: str


Message = Heartbeat | Position | Attitude | Timesync | Granted | Notice


class Mavlink:
    """Writes and reads messages as the onboard computer of a vehicle."""

    def __init__(self, system: int = 1, component: int = _ONBOARD_COMPUTER) -> None:
        self.dialect: Any = import_extra("pymavlink.dialects.v20.common", "px4")
        self._system = system
        self._out = self.dialect.MAVLink(None, system, component)

    def velocity_setpoint(self, setpoint: np.ndarray, time: float) -> bytes:
        """Writes a velocity setpoint (4,): v_WB [m/s] and heading [rad], NaN to keep it; `time` [s]
        is since the start."""
        velocity, heading = swap_px4(setpoint[:3]), float(setpoint[3])
        free = math.isnan(heading)
        return self.packed(
            "set_position_target_local_ned",
            *(milliseconds(time), self._system, 1, self.dialect.MAV_FRAME_LOCAL_NED),
            VELOCITY_AND_YAW_RATE if free else VELOCITY_AND_YAW,
            *(0.0, 0.0, 0.0, *map(float, velocity), 0.0, 0.0, 0.0),
            0.0 if free else -heading,  # Yaw is clockwise.
            0.0,
        )

    def body_rates(
        self, command: np.ndarray, hover_thrust: float, gravity: float, time: float
    ) -> bytes:
        """Writes a command (4,): thrust over mass [m/s^2] and w_cmd_B [rad/s]; `time` [s] is since
        the start. PX4's thrust is from 0 to 1, and `hover_thrust`, MPC_THR_HOVER, in a hover."""
        return self.packed(
            "set_attitude_target",
            *(milliseconds(time), self._system, 1, BODY_RATES, [1.0, 0.0, 0.0, 0.0]),
            *map(float, swap_px4(command[1:])),
            min(max(hover_thrust * float(command[0]) / gravity, 0.0), 1.0),
        )

    def odometry(self, pose: np.ndarray, utime: int) -> bytes:
        """Writes the pose (7,) of the vehicle in motion capture, p_WB [m] and q_WB (wxyz), at a
        Unix time [us]."""
        d, unknown = self.dialect, [math.nan] + [0.0] * 20
        return self.packed(
            "odometry",
            *(utime, d.MAV_FRAME_LOCAL_FRD, d.MAV_FRAME_BODY_FRD),
            *map(float, swap_px4(pose[:3])),
            [float(x) for x in swap_px4(pose[3:])],
            *[math.nan] * 6,
            # PX4's EKF2 reads no odometry of the type MOCAP.
            *(unknown, unknown, 0, d.MAV_ESTIMATOR_TYPE_VISION, 0),
        )

    def heartbeat(self) -> bytes:
        """Writes the heartbeat of an onboard computer."""
        d = self.dialect
        types = d.MAV_TYPE_ONBOARD_CONTROLLER, d.MAV_AUTOPILOT_INVALID
        return self.packed("heartbeat", *types, 0, 0, d.MAV_STATE_ACTIVE, 3)

    def set_mode(self, mode: tuple[int, int]) -> bytes:
        """Writes a command for a mode."""
        return self._command(SET_MODE, CUSTOM_MODE, *mode)

    def arm(self) -> bytes:
        """Writes a command to arm the motors."""
        return self._command(ARM, 1.0)

    def timesync(self, timesync: Timesync) -> bytes:
        """Writes a request for the time, or an answer."""
        return self.packed("timesync", *timesync)

    def _command(self, command: int, *parameters: float) -> bytes:
        padded = [*map(float, parameters), *[0.0] * (7 - len(parameters))]
        return self.packed("command_long", self._system, 1, command, 0, *padded)

    def packed(self, name: str, *values: Any) -> bytes:
        """Writes a message of a type with the values of its fields."""
        message = getattr(self.dialect, f"MAVLink_{name}_message")(*values)
        return bytes(message.pack(self._out))

    def read(self, packet: bytes) -> tuple[list[Message], list[str]]:
        """Reads the messages of a packet, and the reasons for rejecting others; ignores messages of
        other types and of other systems."""
        parser = self.dialect.MAVLink(None)
        parser.robust_parsing = True  # Unknown messages are not errors.
        parsed = parser.parse_buffer(packet) or []
        bad = [message.reason for message in parsed if message.get_type() == "BAD_DATA"]
        refused = [f"the packet must be MAVLink, got {bad[0]}"] if bad else []
        if sum(len(message.get_msgbuf()) for message in parsed) != len(packet):
            refused.append(f"the packet of {len(packet)} bytes must end with a whole message")
        messages: list[Message] = []
        for m in parsed:
            if (m.get_srcSystem(), m.get_srcComponent()) == (self._system, 1):
                try:
                    messages += _message(m)
                except ValueError as error:
                    refused.append(f"{m.get_type()}: {error}")
        return messages, refused


def milliseconds(time: float) -> int:
    """Converts seconds since the start to MAVLink's 32 bits of milliseconds."""
    return round(time * 1e3) & 0xFFFFFFFF


def _message(m: Any) -> list[Message]:
    """Converts a message, those of other types to an empty list; raises ValueError for invalid
    numbers."""
    match m.get_type():
        case "HEARTBEAT":
            mode = (m.custom_mode >> 16) & 0xFF, (m.custom_mode >> 24) & 0xFF
            return [Heartbeat(bool(m.base_mode & ARMED), mode)]
        case "LOCAL_POSITION_NED":
            p, v = finite([m.x, m.y, m.z]), finite([m.vx, m.vy, m.vz])
            return [Position(1e-3 * m.time_boot_ms, swap_px4(p), swap_px4(v))]
        case "ATTITUDE_QUATERNION":
            q = finite([m.q1, m.q2, m.q3, m.q4])
            w = finite([m.rollspeed, m.pitchspeed, m.yawspeed])
            require_unit_quaternion(q)
            return [Attitude(1e-3 * m.time_boot_ms, swap_px4(q), swap_px4(w))]
        case "TIMESYNC":
            return [Timesync(m.tc1, m.ts1)]
        case "COMMAND_ACK":
            if m.target_component not in (0, _ONBOARD_COMPUTER):
                return []
            if m.result == _RESULTS.index("ACCEPTED"):
                return [Granted(m.command)]
            result = _RESULTS[m.result] if m.result < len(_RESULTS) else f"result {m.result}"
            what = {SET_MODE: "a mode", ARM: "arming"}.get(m.command, f"command {m.command}")
            return [Notice(f"the answer to the request for {what} is {result}")]
        case "STATUSTEXT" if m.severity <= _WARNING:
            return [Notice(m.text)]
    return []
