"""LogInbox: replays a ULog of PX4 as the messages of its link."""

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.px4 import mavlink

_PERIOD = 0.0195  # [s] Minimum time between messages of a type: streams of 50 Hz, and jitter.
_MODES = {4: mavlink.HOLD, 14: mavlink.OFFBOARD, 18: mavlink.LAND}  # by nav_state
_OTHER = (1, 0)  # Manual, for all modes that no part of this program knows.


class LogInbox:
    """Receives what PX4 would have sent during a log, instead of a `UdpInbox`: LOCAL_POSITION_NED
    while position and velocity are valid, ATTITUDE_QUATERNION and, each second, HEARTBEAT. Counts
    the messages that are sent to PX4, by type, in `sent`.

    Args:
        path: a ULog with the topics vehicle_local_position, vehicle_attitude and vehicle_status.
        system: MAVLink's number of the vehicle.
        now: returns the time [s]; the log begins when packets are first received.
    """

    port = 0

    def __init__(self, path: Path, system: int, now: Callable[[], float]) -> None:
        self._link = mavlink.Mavlink(system, component=1)
        self._parser = self._link.dialect.MAVLink(None)
        self._now, self._begin, self._next, self.sent = now, math.nan, 0, Counter[str]()
        topics = _read_topics(path)
        self.velocity_error = _velocity_error(topics["vehicle_local_position"])
        rows = *self._positions(topics), *self._attitudes(topics), *self._heartbeats(topics)
        packets = [(time, self._link.packed(*message)) for time, *message in rows]
        self._packets = sorted(packets, key=lambda packet: packet[0])

    def close(self) -> None:
        """Does nothing, since no socket is open."""

    @property
    def is_over(self) -> bool:
        """Checks if all packets of the log have been received."""
        return self._next == len(self._packets)

    def send(self, packet: bytes, address: tuple[str, int]) -> None:
        """Counts a packet."""
        self.sent.update(message.get_type() for message in self._parser.parse_buffer(packet) or [])

    def receive(self) -> tuple[list[bytes], int]:
        """Returns the packets that have come, oldest first, and 0 packets of strangers."""
        now = self._now()
        self._begin = now if math.isnan(self._begin) else self._begin
        until, first = self._packets[0][0] + now - self._begin, self._next
        while not self.is_over and self._packets[self._next][0] <= until:
            self._next += 1
        return [packet for _, packet in self._packets[first : self._next]], 0

    def _positions(self, topics: dict) -> list[tuple]:
        topic = topics["vehicle_local_position"]
        p_and_v = np.column_stack([topic[name] for name in ("x", "y", "z", "vx", "vy", "vz")])
        is_valid = (topic["xy_valid"] & topic["v_xy_valid"]).astype(bool)
        return [
            (time, "local_position_ned", mavlink.milliseconds(time), *values.tolist())
            for time, values, valid in _at_50_hz(topic, p_and_v, is_valid)
            if valid
        ]

    def _attitudes(self, topics: dict) -> list[tuple]:
        topic, gyro = topics["vehicle_attitude"], topics.get("vehicle_angular_velocity")
        q = np.column_stack([topic[f"q[{axis}]"] for axis in range(4)])
        if gyro is None:  # A log from before PX4 1.10.
            rates = [topic[name] for name in ("rollspeed", "pitchspeed", "yawspeed")]
        else:
            at, times = topic["timestamp"], gyro["timestamp"]
            rates = [np.interp(at, times, gyro[f"xyz[{axis}]"]) for axis in range(3)]
        return [
            (time, "attitude_quaternion", mavlink.milliseconds(time), *quaternion, *w)
            for time, quaternion, w in _at_50_hz(topic, q.tolist(), np.transpose(rates).tolist())
        ]

    def _heartbeats(self, topics: dict) -> list[tuple]:
        topic, d = topics["vehicle_status"], self._link.dialect
        times = 1e-6 * topic["timestamp"]
        packets = []
        for time in np.arange(times[0], topics["vehicle_attitude"]["timestamp"][-1] * 1e-6, 1.0):
            row = np.searchsorted(times, time, side="right") - 1
            main, sub = _MODES.get(int(topic["nav_state"][row]), _OTHER)
            base = mavlink.CUSTOM_MODE | (mavlink.ARMED if topic["arming_state"][row] == 2 else 0)
            kind = d.MAV_TYPE_QUADROTOR, d.MAV_AUTOPILOT_PX4
            values = *kind, base, (main << 16) | (sub << 24), d.MAV_STATE_ACTIVE, 3
            packets.append((float(time), "heartbeat", *values))
        return packets


def _read_topics(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads the first instance of each topic; raises ValueError if one is missing."""
    pyulog = import_extra("pyulog", "px4")
    required = ("vehicle_local_position", "vehicle_attitude", "vehicle_status")
    try:
        log = pyulog.ULog(str(path), [*required, "vehicle_angular_velocity"], True)
    except Exception as error:  # Its own, TypeError and others, by the kind of damage.
        raise ValueError(f"{path} must be a ULog: {error}") from None
    topics = {each.name: each.data for each in reversed(log.data_list)}
    if missing := [name for name in required if name not in topics]:
        raise ValueError(f"{path} must have the topics {', '.join(missing)}")
    return topics


def _at_50_hz(topic: dict[str, np.ndarray], *columns: Any) -> list[tuple]:
    rows, last = [], -math.inf
    for row in zip(1e-6 * topic["timestamp"], *columns, strict=True):
        if row[0] - last >= _PERIOD:
            rows.append((float(row[0]), *row[1:]))
            last = row[0]
    return rows


def _velocity_error(topic: dict[str, np.ndarray]) -> np.ndarray:
    """Computes the root mean square (3,) [m/s], in PX4's frame, of the difference between the
    derivative of positions and the mean of velocities."""
    p, v = (np.column_stack([topic[f"{d}{axis}"] for axis in "xyz"]) for d in ("", "v"))
    duration = 1e-6 * np.diff(topic["timestamp"])[:, None]
    error = np.diff(p, axis=0) / duration - 0.5 * (v[1:] + v[:-1])
    return np.sqrt(np.mean(error**2, axis=0))
