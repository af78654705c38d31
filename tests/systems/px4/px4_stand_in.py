"""A STAND-IN for PX4, which is in no package registry: real MAVLink over UDP, a quadrotor, and the
rules of offboard mode in PX4's documentation of v1.16 and v1.18. PX4 may differ."""

import socket

import numpy as np
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, flatness_command
from splatpilot.systems.vehicle.quadrotor import GRAVITY, QuadrotorParams, hover_state, rk4_step

OFFBOARD, LOITER, LAND, POSITION = (6, 0), (4, 3), (4, 6), (3, 0)
HALF_TURN = Rotation.from_euler("x", 180, degrees=True)
STEP = 0.01  # [s]
BOOT = -123.4  # [s], when it began.


class Px4StandIn:
    """A vehicle at p_WB (3,) [m] in flight, with the rules of offboard mode of "1.16" or "1.18"."""

    def __init__(self, version: str, p_WB):
        self.streamed_before = {"1.16": 1.0, "1.18": 0.0}[version]
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.port, self.peer = self.socket.getsockname()[1], None
        self.link, self.parser = dialect.MAVLink(None, 1, 1), dialect.MAVLink(None)
        self.state = hover_state(p_WB)
        self.armed, self.mode = False, POSITION
        self.velocity, self.heading, self.rates = np.zeros(3), np.nan, None
        self.stream_began = self.last_setpoint = -np.inf
        self.odometry, self.refused, self.answers, self.heard = [], [], [], []
        self.offsets = []  # [s] What is added to our time for its own, by TIMESYNC.
        self.tick = 0
        self.delay, self.delayed = 0.0, []  # [s] Of states, and when those that wait are due.
        self.muted: set[str] = set()  # Types of messages that it does not send.

    def step(self, now: float) -> None:
        """Simulates until `now` [s]."""
        while self.tick * STEP <= now + 1e-9:
            self._receive(self.tick * STEP)
            self._fly(self.tick * STEP)
            self._tell(self.tick * STEP)
            self.tick += 1

    def _receive(self, now: float) -> None:
        while True:
            try:
                packet, self.peer = self.socket.recvfrom(65536)
            except BlockingIOError:
                return
            for message in self.parser.parse_buffer(packet) or []:
                self.heard.append(message.get_type())
                self._obey(message, now)

    def _obey(self, message, now: float) -> None:
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            frames = dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_NED
            valid = message.coordinate_frame in frames and message.type_mask in (1479, 2503)
            if self._streamed(message, now, valid):
                ned = np.array([message.vx, message.vy, message.vz])
                self.velocity, self.rates = HALF_TURN.apply(ned), None
                self.heading = -message.yaw if message.type_mask == 2503 else np.nan
        elif kind == "SET_ATTITUDE_TARGET":
            valid = message.type_mask == 128 and 0.0 <= message.thrust <= 1.0
            if self._streamed(message, now, valid):
                frd = [message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate]
                self.rates = np.append(message.thrust / 0.5 * GRAVITY, HALF_TURN.apply(frd))
        elif kind == "ODOMETRY" and message.estimator_type <= dialect.MAV_ESTIMATOR_TYPE_VIO:
            self.odometry.append(message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._send(dialect.MAVLink_timesync_message(round(1e9 * (now - BOOT)), message.ts1))
        elif kind == "TIMESYNC":
            self.offsets.append(0.5e-9 * message.ts1 + 0.5 * (now - BOOT) - 1e-9 * message.tc1)
        elif kind == "COMMAND_LONG":
            accepted = self._command(message, now)
            result = dialect.MAV_RESULT_ACCEPTED if accepted else dialect.MAV_RESULT_DENIED
            self.answers.append((message.command, accepted))
            self._send(dialect.MAVLink_command_ack_message(message.command, result))

    def _streamed(self, message, now: float, valid: bool) -> bool:
        if not valid:
            self.refused.append(message)
            return False
        if now - self.last_setpoint > 0.5:
            self.stream_began = now
        self.last_setpoint = now
        return True

    def _command(self, message, now: float) -> bool:
        flows = now - self.last_setpoint <= 0.5
        may_fly_offboard = flows and now - self.stream_began >= self.streamed_before
        armed, mode = self.armed, self.mode
        if message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            armed = bool(message.param1)
            accepted = not (armed and mode == OFFBOARD) or may_fly_offboard
        else:
            mode = int(message.param2), int(message.param3)
            is_mode = message.command == dialect.MAV_CMD_DO_SET_MODE
            accepted = is_mode and (mode != OFFBOARD or may_fly_offboard)
        if accepted:
            self.armed, self.mode = armed, mode
        return accepted

    def _fly(self, now: float) -> None:
        if self.mode == OFFBOARD and now - self.last_setpoint > 1.0:  # COM_OF_LOSS_T
            self.mode = LOITER  # COM_OBL_RC_ACT
        if not self.armed:
            return
        is_offboard, vehicle = self.mode == OFFBOARD, QuadrotorParams()
        command = self.rates if is_offboard else None
        if command is None:
            descent = np.array([0.0, 0.0, -0.5 if self.mode == LAND else 0.0])
            desired, heading = (self.velocity, self.heading) if is_offboard else (descent, np.nan)
            a_WB = tracking_acceleration(self.state[3:6], desired)
            law = FlatnessControllerConfig()
            command = flatness_command(self.state, a_WB, np.zeros(3), heading, law, vehicle)
        self.state = rk4_step(self.state, command, vehicle, STEP)

    def _tell(self, now: float) -> None:
        milliseconds = round((now - BOOT) * 1e3)
        if self.tick % 2 == 0:
            noise = 1e-4 * np.sin(now)  # [m]: an estimate is never the same for long.
            p, v = HALF_TURN.apply(self.state[:3] + noise), HALF_TURN.apply(self.state[3:6])
            R_WB = Rotation.from_quat(self.state[6:10], scalar_first=True)
            q = (HALF_TURN * R_WB * HALF_TURN.inv()).as_quat(scalar_first=True)
            rates, due = HALF_TURN.apply(self.state[10:13]), now + self.delay
            position = dialect.MAVLink_local_position_ned_message(milliseconds, *p, *v)
            attitude = dialect.MAVLink_attitude_quaternion_message(milliseconds, *q, *rates)
            self.delayed += [(due, position), (due, attitude)]
        while self.delayed and self.delayed[0][0] <= now + 1e-9:
            self._send(self.delayed.pop(0)[1])
        if self.tick % 10 == 0:
            self._send(dialect.MAVLink_timesync_message(0, round(1e9 * (now - BOOT))))
        if self.tick % 100 == 0:  # PX4's heartbeat has 1 Hz, whatever is requested.
            base = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            base |= dialect.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
            custom = (self.mode[0] << 16) | (self.mode[1] << 24)
            kind = dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4
            status = base, custom, dialect.MAV_STATE_ACTIVE, 3
            self._send(dialect.MAVLink_heartbeat_message(*kind, *status))

    def _send(self, message) -> None:
        if self.peer is not None and message.get_type() not in self.muted:
            self.socket.sendto(bytes(message.pack(self.link)), self.peer)
