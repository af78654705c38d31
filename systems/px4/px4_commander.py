"""Px4Commander: tells PX4 what the bridge wants."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.message_publisher import PUBLISH_OFFSET
from splatpilot.systems.messaging.udp_inbox import UdpInbox
from splatpilot.systems.ports import input_port, optional_input
from splatpilot.systems.px4.mavlink import HOLD, LAND, OFFBOARD, Mavlink

_HEARTBEAT_PERIOD = 1.0  # [s], and of commands that are said again until they are obeyed.


_TAKEN = -1.0  # Someone else flies: nothing is asked for any more.


@dataclass
class Px4CommanderConfig:
    """What is flown by, and what is asked for."""

    # What PX4 is told: "velocity" or "body_rates".
    setpoints: str = "velocity"
    # Thrust from 0 to 1 that carries the weight, PX4's MPC_THR_HOVER; for body rates.
    hover_thrust: float = 0.5
    # [s] For which setpoints are streamed before offboard mode is asked for.
    streaming: float = 1.5
    # [s] Setpoints that are older are not sent on; offboard mode is left then.
    max_age: float = 0.3
    # Whether to ask for offboard mode. Who flies by remote control does otherwise.
    engage: bool = False
    # Whether to arm the motors, in offboard mode.
    arm: bool = False

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        if self.setpoints not in ("velocity", "body_rates"):
            raise ValueError(
                f"px4.setpoints is {self.setpoints!r}; it must be velocity or body_rates"
            )
        if not 0.05 <= self.hover_thrust <= 0.95:
            raise ValueError(
                f"px4.hover_thrust is {self.hover_thrust}; it must be 0.05 to 0.95, what PX4 has "
                "learnt in hover"
            )
        for name in ("streaming", "max_age"):
            if not 0.0 < getattr(self, name) <= 10.0:
                raise ValueError(
                    f"px4.{name} is {getattr(self, name)} s; it must be positive and at most 10"
                )
        if self.arm and not self.engage:
            raise ValueError("px4.arm is asked for without px4.engage; give both")


class _Memory(NamedTuple):
    """The discrete state."""

    streaming: float = math.nan  # [s], since when setpoints have been sent.
    flown: float = 0.0  # Whether offboard mode has been reached.
    left: float = 0.0  # 0, the sub mode that offboard mode is left for, or `_TAKEN`.
    asked: float = -math.inf  # [s], when something was asked for last.


class _Arrival(NamedTuple):
    """Of setpoints, in the discrete state too."""

    age: float = math.inf  # [s], at the last look; it falls where a setpoint has come.
    time: float = -math.inf  # [s], when the last one came.


class Px4Commander(LeafSystem):
    """Streams setpoints to PX4, enters offboard mode where that is asked for, and leaves it.

    .. pydrake_system::

        name: Px4Commander
        input_ports:
        - setpoint
        - setpoint_age
        - bridge_mode
        - armed
        - mode
        - motion_capture_pose
        - motion_capture_age
        - unix_time

    - ``setpoint`` (4), ``setpoint_age`` (1) [s]: a velocity setpoint or a command of body rates, as
      the configuration says, and its age.
    - ``bridge_mode`` (1), optional: the mode in the bridge's status, see ``lcmt_bridge_status``.
    - ``armed`` (1), ``mode`` (2): of :class:`~splatpilot.systems.px4.px4_telemetry.Px4Telemetry`.
    - ``motion_capture_pose`` (7), ``motion_capture_age`` (1) [s], optional: p_WB [m] and q_WB of
      the vehicle, sent on as ODOMETRY while it is no older than a setpoint may be.
    - ``unix_time`` (1): [s].

    Every ``period`` from time 0 it sends the setpoint, if it is fresh, and the odometry, and the
    setpoint also as it comes, for which it looks every ``tick``; every second a heartbeat. After
    ``streaming`` seconds of setpoints it asks for offboard mode, and in it to arm, each where the
    configuration says so and the bridge flies, once a second until PX4 does. Where setpoints cease
    it asks for hold, and where the bridge lands for PX4's own landing, and sends no more setpoints:
    offboard mode is not entered again. Nor is it where it was left by someone else.
    """

    setpoint_input_port = input_port("setpoint")
    setpoint_age_input_port = input_port("setpoint_age")
    bridge_mode_input_port = input_port("bridge_mode")
    armed_input_port = input_port("armed")
    mode_input_port = input_port("mode")
    motion_capture_pose_input_port = input_port("motion_capture_pose")
    motion_capture_age_input_port = input_port("motion_capture_age")
    unix_time_input_port = input_port("unix_time")

    def __init__(
        self,
        config: Px4CommanderConfig,
        inbox: UdpInbox,
        mavlink: Mavlink,
        address: tuple[str, int],
        gravity: float,
        period: float = 0.02,
        tick: float = 0.002,
    ):
        """Constructs the system.

        Args:
            config: what is asked for.
            inbox: whose socket is sent from.
            mavlink: that writes the messages.
            address: host and port of PX4.
            gravity: [m/s^2].
            period: [s] between setpoints.
            tick: [s] between looks at whether one has come; the period is whole ticks.

        Raises:
            ValueError: on a configuration out of range.
        """
        super().__init__()
        config.validate()
        self._config, self._inbox, self._mavlink = config, inbox, mavlink
        self._address, self._gravity, self._period = address, gravity, period
        for name, size in (
            *(("setpoint", 4), ("setpoint_age", 1), ("bridge_mode", 1), ("armed", 1), ("mode", 2)),
            *(("motion_capture_pose", 7), ("motion_capture_age", 1), ("unix_time", 1)),
        ):
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.array(_Memory()))
        self._arrival = int(self.DeclareDiscreteState(np.array(_Arrival())))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(tick, 0.0, self._look)
        self.DeclarePeriodicPublishEvent(period, PUBLISH_OFFSET, self._publish)
        self.DeclarePeriodicPublishEvent(tick, PUBLISH_OFFSET, self._publish_at_once)

    def _is_fresh(self, context: Context, name: str) -> bool:
        age = optional_input(self, name, context)
        return age is not None and bool(age[0] <= self._config.max_age)

    def _is_in(self, context: Context, mode: tuple[int, int]) -> bool:
        now = optional_input(self, "mode", context)
        assert now is not None
        return now[0] == mode[0] and (mode == OFFBOARD or now[1] == mode[1])

    def _request(self, context: Context) -> bytes | None:
        """What PX4 is to be asked for; None where it does it, or nobody asks for it."""
        memory, config = _memory(context), self._config
        armed = optional_input(self, "armed", context)
        assert armed is not None
        if memory.left:
            mode = (HOLD[0], int(memory.left))
            taken = memory.left == _TAKEN or self._is_in(context, mode) or not armed[0]
            return None if taken else self._mavlink.set_mode(mode)
        streamed = context.get_time() - memory.streaming >= config.streaming
        bridge = optional_input(self, "bridge_mode", context)
        flies = bridge is None or bridge[0] == status.FLYING
        if not (config.engage and streamed and flies):
            return None
        if not self._is_in(context, OFFBOARD):
            return None if memory.flown else self._mavlink.set_mode(OFFBOARD)
        return self._mavlink.arm() if config.arm and not armed[0] and not memory.flown else None

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, memory = context.get_time(), _memory(context)
        fresh, armed = (
            self._is_fresh(context, "setpoint_age"),
            optional_input(self, "armed", context),
        )
        assert armed is not None
        mode = optional_input(self, "bridge_mode", context)
        if not fresh:
            memory = memory._replace(streaming=math.nan)
        elif math.isnan(memory.streaming):
            memory = memory._replace(streaming=now)
        offboard = self._is_in(context, OFFBOARD)
        if offboard and armed[0]:
            memory = memory._replace(flown=1.0)
        landing = mode is not None and mode[0] == status.LANDING
        if memory.flown and not offboard:  # By us, by PX4, or by a pilot, who is not fought.
            memory = memory._replace(left=_TAKEN)
        elif memory.flown and memory.left == 0 and (landing or not fresh):
            left = LAND if landing else HOLD
            memory = memory._replace(left=float(left[1]), asked=-math.inf)
        if now - memory.asked >= _HEARTBEAT_PERIOD and self._request(context) is not None:
            memory = memory._replace(asked=now)
        discrete_state.set_value(0, np.array(memory))

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        age = optional_input(self, "setpoint_age", context)
        assert age is not None
        last = _Arrival(*np.asarray(context.get_discrete_state(self._arrival).value()))
        time = context.get_time() if age[0] < last.age else last.time
        discrete_state.set_value(self._arrival, np.array(_Arrival(age[0], time)))

    def _publish_at_once(self, context: Context) -> None:
        now = context.get_time() - PUBLISH_OFFSET
        came = context.get_discrete_state(self._arrival)[1]
        is_due = abs(math.remainder(now, self._period)) < PUBLISH_OFFSET  # And is sent anyway.
        if now - came < PUBLISH_OFFSET and not is_due:
            self._publish_setpoint(context)

    def _publish_setpoint(self, context: Context) -> None:
        now = context.get_time() - PUBLISH_OFFSET
        if not self._is_fresh(context, "setpoint_age") or _memory(context).left:
            return
        setpoint = optional_input(self, "setpoint", context)
        assert setpoint is not None
        if self._config.setpoints == "velocity":
            self._send(self._mavlink.velocity_setpoint(setpoint, now))
        else:
            thrust = self._config.hover_thrust
            self._send(self._mavlink.body_rates(setpoint, thrust, self._gravity, now))

    def _publish(self, context: Context) -> EventStatus:
        memory, mavlink = _memory(context), self._mavlink
        now = context.get_time() - PUBLISH_OFFSET
        tick = round(now / self._period)
        if tick % round(_HEARTBEAT_PERIOD / self._period) == 0:
            self._send(mavlink.heartbeat())
        self._publish_setpoint(context)
        pose = optional_input(self, "motion_capture_pose", context)
        if pose is not None and self._is_fresh(context, "motion_capture_age"):
            unix_time, age = (
                optional_input(self, name, context) for name in ("unix_time", "motion_capture_age")
            )
            assert unix_time is not None and age is not None
            self._send(mavlink.odometry(pose, round((unix_time[0] - age[0]) * 1e6)))
        if abs(now - memory.asked) < 0.5 * self._period:
            request = self._request(context)
            if request is not None:
                self._send(request)
        return EventStatus.Succeeded()

    def _send(self, packet: bytes) -> None:
        self._inbox.send(packet, self._address)


def _memory(context: Context) -> _Memory:
    return _Memory(*np.asarray(context.get_discrete_state(0).value()))
