"""Px4Commander: streams setpoints to PX4 and requests its modes."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from splatpilot.systems.common.drake import optional_input, vector_input
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET, SAME_TIME
from splatpilot.systems.messaging.receiver import Inbox
from splatpilot.systems.px4.mavlink import HOLD, LAND, OFFBOARD, Mavlink
from splatpilot.systems.px4.telemetry import HEARTBEAT_TIMEOUT
from splatpilot.systems.vehicle.state import LONGEST_PREDICTION

_PERIOD = 0.02  # [s] between setpoints.
_HEARTBEAT_PERIOD = 1.0  # [s], also between repeated commands.
_BRAKING = 2.0  # [s] of stopping PX4 after the last setpoint: two of its heartbeats.
_STOP = np.array([0.0, 0.0, 0.0, math.nan])  # A velocity setpoint.
_TAKEN = -1.0  # Someone else flies: nothing is requested any more.

_INPUTS = {
    **{"setpoint": 4, "setpoint_age": 1, "bridge_mode": 1, "heartbeat_age": 1, "armed": 1},
    **{"mode": 2, "granted": 2, "motion_capture_pose": 7, "motion_capture_age": 1, "unix_time": 1},
}


@dataclass
class Px4CommanderConfig(Config):
    """Setpoints and requests of a `Px4Commander`."""

    # Setpoints for PX4: "velocity" or "body_rates".
    setpoints: str = bounded("velocity", "{velocity, body_rates}")
    # Thrust from 0 to 1 that carries the weight, PX4's MPC_THR_HOVER; for body rates.
    hover_thrust: float = bounded(0.5, "[0.05, 0.95]")
    # [s] Of streaming setpoints before requesting offboard mode.
    streaming: float = bounded(1.5, "(0, 10] s")
    # [s] Max age of setpoints that are sent on, of body rates at most 0.1 s; then offboard mode is
    # left.
    max_age: float = bounded(0.3, "(0, 10] s")
    # Requests offboard mode; without it the pilot does by remote control.
    engage: bool = False
    # Arms the motors, in offboard mode.
    arm: bool = False

    def check(self) -> None:
        require_field(self, "arm", self.engage or not self.arm, "false without engage")


class _Memory(NamedTuple):
    """The discrete state."""

    streaming: float = math.nan  # [s] since when setpoints have been sent.
    entered: float = 0.0  # 1 if offboard mode has been reached or granted.
    flown: float = 0.0  # 1 if it has been reached with motors armed.
    ceased: float = math.nan  # [s] since when the bridge has been silent or landing.
    left: float = 0.0  # 0, the sub mode that replaces offboard mode, or `_TAKEN`.
    asked: float = -math.inf  # [s] of the last request.

    @classmethod
    def read(cls, context: Context) -> "_Memory":
        return cls(*np.asarray(context.get_discrete_state(0).value()))


class _Arrival(NamedTuple):
    """Time of the last setpoint or pose, in the discrete state too."""

    sent: float = -math.inf  # [s] Unix time.
    time: float = -math.inf  # [s] of the Context, of its arrival.


class Px4Commander(LeafSystem):
    """Streams setpoints to PX4, enters offboard mode if configured, and leaves it.

    .. pydrake_system::

        name: Px4Commander
        input_ports: [setpoint, setpoint_age, bridge_mode, heartbeat_age, armed, mode, granted,
            motion_capture_pose, motion_capture_age, unix_time]
        output_ports: [ended]

    - ``setpoint`` (4), ``setpoint_age`` (1) [s]: velocities or body rates, as configured.
    - ``bridge_mode`` (1), optional: the mode in the bridge's status, see ``lcmt_bridge_status``.
    - ``heartbeat_age`` (1) [s], ``armed`` (1), ``mode`` (2), ``granted`` (2): of `Px4Telemetry`.
    - ``motion_capture_pose`` (7), ``motion_capture_age`` (1) [s], optional: p_WB [m] and q_WB.
    - ``ended`` (1): 1 once no more setpoints are sent, else 0.

    Sends setpoints, if fresh, every 0.02 s from time 0 and as they come, for which it looks every
    ``tick`` [s]; every second a heartbeat; and poses as ODOMETRY, each once and at most every
    0.018 s, if they are as fresh.

    After ``streaming`` seconds of setpoints it requests offboard mode, and in it arming, each if
    configured and if the bridge flies, once a second until PX4 grants it.

    If setpoints cease in flight it has PX4 stop, by setpoints of its own, and requests hold. If the
    bridge lands it requests PX4's own landing. Then, or if someone else leaves offboard mode, it
    sends no more setpoints, and does not enter that mode again. A pilot may have taken over since
    PX4's last heartbeat: it requests nothing until a heartbeat has come since the reason for it
    arose, and since its last request.
    """

    def __init__(
        self,
        config: Px4CommanderConfig,
        inbox: Inbox,
        mavlink: Mavlink,
        address: tuple[str, int],
        gravity: float,
        tick: float = 0.002,
    ):
        super().__init__()
        config.validate()
        self._config, self._mavlink, self._gravity = config, mavlink, gravity
        self._send = lambda packet: inbox.send(packet, address)
        for name, size in _INPUTS.items():
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.array(_Memory()))
        intervals = {"setpoint_age": SAME_TIME, "motion_capture_age": 0.9 * _PERIOD}
        # By the ages of arrivals: the min time between two that are sent on [s], and the state.
        self._arrivals = {
            name: (interval, int(self.DeclareDiscreteState(np.array(_Arrival()))))
            for name, interval in intervals.items()
        }
        self.DeclareVectorOutputPort("ended", 1, self._calc_ended, {self.xd_ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(tick, 0.0, self._look)
        self.DeclarePeriodicPublishEvent(_PERIOD, PUBLISH_OFFSET, self._publish)
        self.DeclarePeriodicPublishEvent(tick, PUBLISH_OFFSET, self._publish_arrivals)

    def _is_fresh(self, context: Context, name: str) -> bool:
        age, limit = optional_input(self, name, context), self._config.max_age
        if name == "setpoint_age" and self._config.setpoints == "body_rates":
            limit = min(limit, LONGEST_PREDICTION)  # A vehicle would turn over.
        return age is not None and bool(age[0] <= limit)

    def _is_in(self, context: Context, mode: tuple[int, int]) -> bool:
        now = vector_input(self, "mode", context)
        return now[0] == mode[0] and (mode == OFFBOARD or now[1] == mode[1])

    def _bridge_is(self, context: Context, mode: int, unknown: bool) -> bool:
        bridge = optional_input(self, "bridge_mode", context)
        return unknown if bridge is None else bool(bridge[0] == mode)

    def _request(self, context: Context) -> bytes | None:
        """Returns the pending request, if any."""
        memory, config = _Memory.read(context), self._config
        armed = bool(vector_input(self, "armed", context)[0])
        if memory.left:
            mode = (HOLD[0], int(memory.left))
            taken = memory.left == _TAKEN or self._is_in(context, mode) or not armed
            return None if taken else self._mavlink.set_mode(mode)
        streamed = context.get_time() - memory.streaming >= config.streaming
        flies = self._bridge_is(context, status.FLYING, unknown=True)
        if not (config.engage and streamed and flies):
            return None
        if not self._is_in(context, OFFBOARD):
            return None if memory.entered else self._mavlink.set_mode(OFFBOARD)
        may_arm = config.arm and not (memory.flown or vector_input(self, "granted", context)[1])
        return self._mavlink.arm() if may_arm and not armed else None

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, memory = context.get_time(), _Memory.read(context)
        age = vector_input(self, "heartbeat_age", context)[0]
        heard, is_known = now - age, age <= HEARTBEAT_TIMEOUT
        fresh, offboard = self._is_fresh(context, "setpoint_age"), self._is_in(context, OFFBOARD)
        landing = self._bridge_is(context, status.LANDING, unknown=False)
        if not fresh:
            memory = memory._replace(streaming=math.nan)
        elif math.isnan(memory.streaming):
            memory = memory._replace(streaming=now)
        if fresh and not landing:
            memory = memory._replace(ceased=math.nan)
        elif math.isnan(memory.ceased):
            memory = memory._replace(ceased=now)
        if offboard or vector_input(self, "granted", context)[0]:
            memory = memory._replace(entered=1.0)
        if offboard and vector_input(self, "armed", context)[0]:
            memory = memory._replace(flown=1.0)
        if memory.flown and is_known and not offboard:  # By us, PX4 or a pilot, who is not fought.
            memory = memory._replace(left=_TAKEN)
        elif memory.flown and memory.left == 0 and heard > memory.ceased:
            memory = memory._replace(left=float((LAND if landing else HOLD)[1]), asked=-math.inf)
        may_ask = is_known and heard > memory.asked and now - memory.asked >= _HEARTBEAT_PERIOD
        if may_ask and self._request(context) is not None:
            memory = memory._replace(asked=now)
        discrete_state.set_value(0, np.array(memory))

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        unix_time = vector_input(self, "unix_time", context)[0]
        for name, (interval, index) in self._arrivals.items():
            age = optional_input(self, name, context)
            last = _Arrival(*np.asarray(context.get_discrete_state(index).value()))
            if age is not None and unix_time - age[0] > last.sent + interval:
                arrival = _Arrival(unix_time - age[0], context.get_time())
                discrete_state.set_value(index, np.array(arrival))

    def _has_come(self, context: Context, name: str) -> bool:
        came = context.get_discrete_state(self._arrivals[name][1])[1]
        return context.get_time() - came < 2.0 * PUBLISH_OFFSET and self._is_fresh(context, name)

    def _publish_arrivals(self, context: Context) -> None:
        now = context.get_time() - PUBLISH_OFFSET
        is_due = abs(math.remainder(now, _PERIOD)) < PUBLISH_OFFSET  # `_publish` sends it.
        if self._has_come(context, "setpoint_age") and not is_due:
            self._publish_setpoint(context)
        if self._has_come(context, "motion_capture_age"):
            names = "motion_capture_pose", "motion_capture_age", "unix_time"
            pose, age, unix_time = (vector_input(self, name, context) for name in names)
            exposed = max(unix_time[0] - age[0], 0.0)  # MAVLink has no time before its epoch.
            self._send(self._mavlink.odometry(pose, round(exposed * 1e6)))

    def _publish_setpoint(self, context: Context) -> None:
        now, memory = context.get_time() - PUBLISH_OFFSET, _Memory.read(context)
        if memory.left:
            return
        setpoint = vector_input(self, "setpoint", context)
        if not self._is_fresh(context, "setpoint_age"):
            if memory.flown and now - memory.ceased <= _BRAKING:
                self._send(self._mavlink.velocity_setpoint(_STOP, now))
        elif self._config.setpoints == "velocity":
            self._send(self._mavlink.velocity_setpoint(setpoint, now))
        else:
            thrust = self._config.hover_thrust
            self._send(self._mavlink.body_rates(setpoint, thrust, self._gravity, now))

    def _publish(self, context: Context) -> None:
        now, memory = context.get_time() - PUBLISH_OFFSET, _Memory.read(context)
        if round(now / _PERIOD) % round(_HEARTBEAT_PERIOD / _PERIOD) == 0:
            self._send(self._mavlink.heartbeat())
        self._publish_setpoint(context)
        if abs(now - memory.asked) < 0.5 * _PERIOD and (request := self._request(context)):
            self._send(request)

    def _calc_ended(self, context: Context, output: BasicVector) -> None:
        output[0] = _Memory.read(context).left != 0.0
