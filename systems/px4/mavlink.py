"""MAVLink's messages to and from PX4, in our frames."""

import math
from typing import Any, NamedTuple

import numpy as np

from splatpilot.systems.extras import import_extra
from splatpilot.systems.px4.frames import (
    attitude_from_px4,
    attitude_to_px4,
    from_px4,
    heading_to_px4,
    thrust_to_px4,
    to_px4,
)

_ONBOARD_COMPUTER = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
_CUSTOM_MODE, _ARMED = 1, 128  # MAV_MODE_FLAGs

VELOCITY_AND_YAW_RATE, VELOCITY_AND_YAW, BODY_RATES = 1479, 2503, 128
"""What a setpoint ignores: all but what the name says."""

OFFBOARD, HOLD, LAND = (6, 0), (4, 3), (4, 6)
"""PX4's main and sub modes."""


class Heartbeat(NamedTuple):
    """What PX4 says of itself."""

    armed: bool
    mode: tuple[int, int]
    """Main and sub mode."""


class Position(NamedTuple):
    """What PX4 knows of its place."""

    p_WB: np.ndarray  # (3,) [m]
    v_WB: np.ndarray  # (3,) [m/s]


class Attitude(NamedTuple):
    """What PX4 knows of its attitude."""

    q_WB: np.ndarray  # (4, wxyz)
    w_WB_B: np.ndarray  # (3,) [rad/s]


class Mavlink:
    """
    Writes and reads messages as the onboard computer of a vehicle.

    Raises:
        ModuleNotFoundError: where pymavlink is not installed.
    """

    def __init__(self, system: int = 1) -> None:
        self._dialect: Any = import_extra("pymavlink.dialects.v20.common", "px4")
        self._system = system
        self._out = self._dialect.MAVLink(None, system, _ONBOARD_COMPUTER)

    def velocity_setpoint(self, setpoint: np.ndarray, time: float) -> bytes:
        """
        Flies a velocity.

        Args:
            setpoint: (4,) v_WB [m/s] and heading [rad], NaN to keep it.
            time: [s] since the start.
        """
        d, velocity, heading = self._dialect, to_px4(setpoint[:3]), float(setpoint[3])
        free = math.isnan(heading)
        return self._packed(
            d.MAVLink_set_position_target_local_ned_message(
                *(_milliseconds(time), self._system, 1, d.MAV_FRAME_LOCAL_NED),
                VELOCITY_AND_YAW_RATE if free else VELOCITY_AND_YAW,
                *(0.0, 0.0, 0.0, *map(float, velocity), 0.0, 0.0, 0.0),
                0.0 if free else heading_to_px4(heading),
                0.0,
            )
        )

    def body_rates(
        self, command: np.ndarray, hover_thrust: float, gravity: float, time: float
    ) -> bytes:
        """
        Flies body rates.

        Args:
            command: (4,) thrust over mass [m/s^2], w_cmd_B [rad/s].
            hover_thrust, gravity: see `thrust_to_px4`.
            time: [s] since the start.
        """
        thrust = thrust_to_px4(float(command[0]), hover_thrust, gravity)
        return self._packed(
            self._dialect.MAVLink_set_attitude_target_message(
                *(_milliseconds(time), self._system, 1, BODY_RATES, [1.0, 0.0, 0.0, 0.0]),
                *map(float, to_px4(command[1:])),
                thrust,
            )
        )

    def odometry(self, pose: np.ndarray, utime: int) -> bytes:
        """
        Says where motion capture sees the vehicle.

        Args:
            pose: (7,) p_WB [m] and q_WB (wxyz).
            utime: [us].
        """
        d, unknown = self._dialect, [math.nan] + [0.0] * 20
        return self._packed(
            d.MAVLink_odometry_message(
                *(utime, d.MAV_FRAME_LOCAL_FRD, d.MAV_FRAME_BODY_FRD),
                *map(float, to_px4(pose[:3])),
                [float(x) for x in attitude_to_px4(pose[3:])],
                *[math.nan] * 6,
                *(unknown, unknown, 0, d.MAV_ESTIMATOR_TYPE_MOCAP, 0),
            )
        )

    def heartbeat(self) -> bytes:
        """Says that an onboard computer is there."""
        d = self._dialect
        return self._packed(
            d.MAVLink_heartbeat_message(
                d.MAV_TYPE_ONBOARD_CONTROLLER, d.MAV_AUTOPILOT_INVALID, 0, 0, d.MAV_STATE_ACTIVE, 3
            )
        )

    def set_mode(self, mode: tuple[int, int]) -> bytes:
        """Asks for a mode."""
        return self._command(self._dialect.MAV_CMD_DO_SET_MODE, _CUSTOM_MODE, *mode)

    def arm(self) -> bytes:
        """Asks for the motors to be armed."""
        return self._command(self._dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def read(self, packet: bytes) -> list[Heartbeat | Position | Attitude]:
        """
        What a packet says; messages of other kinds and of other systems are left out.

        Raises:
            ValueError: if it holds anything but whole messages, or numbers that are none.
        """
        parser = self._dialect.MAVLink(None)
        parser.robust_parsing = True  # Messages that are not known are none of ours, but no error.
        messages = parser.parse_buffer(packet) or []
        bad = [message.reason for message in messages if message.get_type() == "BAD_DATA"]
        if bad:
            raise ValueError(f"the packet is no MAVLink: {bad[0]}")
        if sum(len(message.get_msgbuf()) for message in messages) != len(packet):
            raise ValueError(f"the packet of {len(packet)} bytes holds no whole message")
        said: list[Heartbeat | Position | Attitude] = []
        for m in messages:
            if (m.get_srcSystem(), m.get_srcComponent()) != (self._system, 1):
                continue
            kind = m.get_type()
            if kind == "HEARTBEAT":
                mode = (m.custom_mode >> 16) & 0xFF, (m.custom_mode >> 24) & 0xFF
                said.append(Heartbeat(bool(m.base_mode & _ARMED), mode))
            elif kind == "LOCAL_POSITION_NED":
                p, v = _finite([m.x, m.y, m.z]), _finite([m.vx, m.vy, m.vz])
                said.append(Position(from_px4(p), from_px4(v)))
            elif kind == "ATTITUDE_QUATERNION":
                q = _finite([m.q1, m.q2, m.q3, m.q4])
                w = _finite([m.rollspeed, m.pitchspeed, m.yawspeed])
                if not abs(np.linalg.norm(q) - 1.0) < 0.01:
                    raise ValueError(f"the attitude {q.tolist()} is no unit quaternion")
                said.append(Attitude(attitude_from_px4(q), from_px4(w)))
        return said

    def _command(self, command: int, *parameters: float) -> bytes:
        padded = [*map(float, parameters), *[0.0] * (7 - len(parameters))]
        return self._packed(
            self._dialect.MAVLink_command_long_message(self._system, 1, command, 0, *padded)
        )

    def _packed(self, message: Any) -> bytes:
        return bytes(message.pack(self._out))


def _milliseconds(time: float) -> int:
    return round(time * 1e3) & 0xFFFFFFFF


def _finite(values: list[float]) -> np.ndarray:
    array = np.array(values, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"values are {array.tolist()}; they must be finite")
    return array
