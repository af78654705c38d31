"""Failsafe: limits a policy's commands, detects faults, and then hovers and lands."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.common.drake import optional_input, vector_input, weak_callback
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.messaging.flight_limits import (
    RETURN_SPEED,
    Box,
    FlightLimits,
    Motion,
    Surroundings,
    limit_speed,
    limit_velocity,
)
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity import tracking_acceleration
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, flatness_command
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.state import LONGEST_PREDICTION, QuadrotorState, predict_state

SEVERITY = (
    *(status.STATE_OLD, status.STATE_FROZEN, status.STATE_JUMPED, status.BODY_LOST),
    *(status.TILTED, status.OVERRUN, status.OUTSIDE, status.OBSERVATION_OLD),
    *(status.POLICY_FAILED, status.NOT_FINITE, status.OUT_OF_BOUNDS, status.NONE),
)
"""Faults, the most severe first: unknown position, danger, unknown target."""

_TOLERANCE = 1.01  # [-] by which a command may exceed the limits of its controller.


@dataclass
class FailsafeConfig(Config):
    """Thresholds and timing of a failsafe."""

    # [s] Max age of the state, the observation and the last sight by motion capture.
    max_age: float = bounded(0.3, "(0, inf) s")
    # [s] Max lag of the process behind the wall clock.
    max_lag: float = bounded(0.3, "(0, inf) s")
    # [s] Without faults, after which the policy flies again.
    recovery: float = bounded(0.5, "(0, inf) s")
    # [s] Of hovering after which the vehicle lands.
    patience: float = bounded(5.0, "(0, inf) s")
    # [m/s] Speed of landing.
    descent: float = bounded(0.5, "(0, inf) m/s")
    limits: FlightLimits = field(default_factory=FlightLimits)


class Signals(NamedTuple):
    """Inputs of a failsafe at one instant."""

    ages: dict[int, float]  # [s] by the fault that a high age is.
    unchanged: float  # [s] since the content of the measured state changed.
    jumped: bool  # True if the measured state does not follow from those before.
    lag: float  # [s] of the process behind the wall clock.
    state: QuadrotorState
    policy_failed: bool  # True if the policy raised an exception.
    setpoint: np.ndarray | None  # (4,) `velocity_setpoint`; None if only commands are sent.
    command: np.ndarray  # (4,) thrust over mass [m/s^2] and body rates [rad/s].

    def state_is_valid(self, max_age: float) -> bool:
        """Checks that the state is neither too old, nor frozen, nor has jumped."""
        return max(self.ages[status.STATE_OLD], self.unchanged) <= max_age and not self.jumped

    def fault(self, config: FailsafeConfig, law: FlatnessControllerConfig, box: Box) -> int:
        """Returns the most severe fault, a reason of `lcmt_bridge_status`, or NONE. The limits of
        `law` hold for the command. The box must hold the vehicle, unless only commands are sent:
        their sender is responsible for the position."""
        max_rates = _TOLERANCE * np.array([law.max_tilt_rate, law.max_tilt_rate, law.max_yaw_rate])
        thrust, rates, p_WB = self.command[0], self.command[1:], self.state.p_WB
        is_thrust = 0.0 <= thrust <= _TOLERANCE * law.max_thrust
        faults = {reason: not age <= config.max_age for reason, age in self.ages.items()} | {
            status.STATE_FROZEN: self.unchanged > config.max_age,
            status.STATE_JUMPED: self.jumped,
            status.OVERRUN: self.lag > config.max_lag,
            status.POLICY_FAILED: self.policy_failed,
            status.NOT_FINITE: not np.isfinite(self.command).all(),
            status.OUT_OF_BOUNDS: not is_thrust or (abs(rates) > max_rates).any(),
            status.TILTED: self.state.tilt > config.limits.max_tilt,
        }
        if self.setpoint is not None:
            is_valid = np.isfinite(self.setpoint[:3]).all() and not math.isinf(self.setpoint[3])
            faults[status.NOT_FINITE] |= not is_valid
            faults[status.OUTSIDE] = ((p_WB < box.lower_W) | (p_WB > box.upper_W)).any()
        return worst(status.NONE, *(reason for reason, found in faults.items() if found))


def worst(*reasons: int) -> int:
    """Returns the most severe of some reasons of `lcmt_bridge_status`."""
    return min(reasons, key=SEVERITY.index)


_POSITION_JUMP = 0.3  # [m] max difference of a position from the integral of velocities, and
_ROTATION_JUMP = 0.3  # [rad] of an attitude from that of angular velocities, in addition to
_TIME_ERROR = 0.1  # [s] of motion, for wrong times of measurement.
_MAX_LAG = 1e-3  # [s] by which the Context's time may fall behind between two states.
_FORGETTING = 0.5  # [s] time constant with which such differences fade.
_STOPPING = 1.0  # [s] of motion until a vehicle that is not heard hovers.


class Track(NamedTuple):
    """The sequence of measured states, in the discrete state of a `Failsafe`."""

    time: float = -math.inf  # [s] of the measurement of the last state with new content,
    changed: float = 0.0  # [s] and of its arrival.
    jumped: float = 0.0  # 1 if it does not follow from those before.
    epoch: float = 0.0  # [s] Unix time of the Context's time 0, which a lag of the process moves.
    state: np.ndarray = np.full(13, math.nan)
    expected: np.ndarray = np.full(13, math.nan)  # state predicted by velocities and body rates.

    @classmethod
    def read(cls, context: Context) -> "Track":
        """Inverts `np.hstack`."""
        vector = np.asarray(context.get_discrete_state(1).value())
        return cls(*vector[:4], state=vector[4:17], expected=vector[17:])

    def after(
        self,
        state: np.ndarray,
        age: float,
        now: float,
        max_gap: float,
        epoch: float,
        in_charge: bool,
    ) -> "Track":
        """Adds a state (13,) that was measured `age` [s] ago.

        It has jumped if it is not where the velocities of the states have led, or not rotated as
        their angular velocities say. Small differences fade. A jump remains one until the state
        comes back, since the map does not fit to the position any more. Measurements more than
        `max_gap` [s] apart, or before and after a lag of the process, start again; if `in_charge`,
        after a gap as after a stop with the same heading, since a vehicle that is not heard hovers.
        """
        if np.array_equal(state, self.state):
            return self
        duration, has_lagged = now - age - self.time, abs(epoch - self.epoch) > _MAX_LAG
        is_gap = duration > max_gap and in_charge and math.isfinite(duration)
        if has_lagged or not (is_gap or 0.0 < duration <= max_gap):
            return Track(now - age, now, 0.0, epoch, state, state)
        old, new = QuadrotorState.of(self.state), QuadrotorState.of(state)
        held = QuadrotorState.of(self.expected)
        if is_gap:
            turn = abs(math.remainder(float(new.heading - held.heading), math.tau))
            speed, rate = np.linalg.norm(old.v_WB), np.linalg.norm(old.w_WB_B)
            is_far = np.linalg.norm(new.p_WB - held.p_WB) > _POSITION_JUMP + speed * _STOPPING
            is_turned = turn > _ROTATION_JUMP + rate * _STOPPING
            p_WB, q_WB = held.p_WB if is_far else new.p_WB, held.q_WB if is_turned else new.q_WB
            expected = new._replace(p_WB=p_WB, q_WB=q_WB).to_vector()
            return Track(now - age, now, float(is_far or is_turned), self.epoch, state, expected)
        v_WB, w_WB_B = (old.v_WB + new.v_WB) / 2, (old.w_WB_B + new.w_WB_B) / 2
        expected = predict_state(held._replace(v_WB=v_WB, w_WB_B=w_WB_B).to_vector(), duration)
        p_WB, _, q_WB, _ = QuadrotorState.of(expected)
        dot = float(q_WB.dot(new.q_WB))
        angle = 2.0 * math.acos(min(abs(dot), 1.0))
        speed = max(np.linalg.norm(each.v_WB) for each in (old, new))
        rate = max(np.linalg.norm(each.w_WB_B) for each in (old, new))
        is_far = np.linalg.norm(new.p_WB - p_WB) > _POSITION_JUMP + speed * _TIME_ERROR
        jumped = is_far or angle > _ROTATION_JUMP + rate * max(duration, _TIME_ERROR)
        if not jumped:
            p_WB += duration / _FORGETTING * (new.p_WB - p_WB)
            q_WB += duration / _FORGETTING * (math.copysign(1.0, dot) * new.q_WB - q_WB)
            q_WB /= np.linalg.norm(q_WB)
        return Track(now - age, now, float(jumped), epoch, state, expected)


_STOPPED = 0.3  # [m/s] below which a position is held instead of braking.
_HOLDING_GAIN = 1.0  # [1/s] with which the vehicle returns to it.
_NO_POSITION = np.full(3, math.nan)


class Modes(NamedTuple):
    """The mode and its history, in the discrete state of a `Failsafe`."""

    mode: float = status.WAITING
    reason: float = status.NONE
    since: float = 0.0  # [s] when the mode began or, later, the failsafe came in charge.
    healthy: float = math.nan  # [s] when the last fault ended.
    in_charge: float = 0.0  # 1 if the vehicle obeyed at its last status.
    p_WH: np.ndarray = _NO_POSITION  # (3,) [m] held position, NaN without one.

    @classmethod
    def read(cls, context: Context) -> "Modes":
        """Inverts `np.hstack`."""
        vector = np.asarray(context.get_discrete_state(0).value())
        return cls(*vector[:5], p_WH=vector[5:])

    def after(
        self, fault: int, waits: bool, in_charge: bool | None, now: float, config: FailsafeConfig
    ) -> "Modes":
        """Returns the modes after another period; `waits` if an input has never come. An unknown
        `in_charge` keeps its last value: a landing continues if the vehicle is not heard."""
        healthy = now if math.isnan(self.healthy) else self.healthy
        healthy = math.nan if fault or waits else healthy
        in_charge = bool(self.in_charge) if in_charge is None else in_charge
        modes = self._replace(healthy=healthy, in_charge=in_charge)
        if self.mode == status.WAITING:
            return modes if waits else modes._begin(status.FLYING, status.NONE, now)
        if self.mode == status.FLYING:
            return modes._begin(status.HOLDING, fault, now) if fault else modes
        if self.mode == status.LANDING and not in_charge:
            return modes._begin(status.HOLDING, fault or int(self.reason), now)
        modes = modes._replace(reason=worst(fault, int(self.reason)))
        if self.mode == status.HOLDING:
            if now - healthy >= config.recovery:
                return modes._begin(status.FLYING, status.NONE, now)
            if not in_charge:  # A pilot may move it.
                return modes._replace(since=now, p_WH=_NO_POSITION)
            if now - self.since > config.patience:
                return modes._replace(mode=status.LANDING, since=now)
        return modes

    def _begin(self, mode: int, reason: int, now: float) -> "Modes":
        return self._replace(mode=mode, reason=reason, since=now, p_WH=_NO_POSITION)

    def hold(self, state: QuadrotorState | None) -> "Modes":
        """Adds the held position once the vehicle is at rest; removes it without a valid state."""
        if state is None:
            return self._replace(p_WH=_NO_POSITION)
        is_moving = not np.linalg.norm(state.v_WB) < _STOPPED
        if self.mode == status.FLYING or is_moving or not math.isnan(self.p_WH[0]):
            return self
        return self._replace(p_WH=state.p_WB)

    def setpoint(
        self,
        desired: np.ndarray | None,
        motion: Motion | None,
        near: Surroundings,
        config: FailsafeConfig,
    ) -> tuple[np.ndarray, int]:
        """Computes the velocity setpoint (4,) of the mode from that of the policy, None if only
        commands are sent; `motion` is None without a valid state. Also returns the limit that
        changed it, a reason of `lcmt_bridge_status`, or NONE."""
        landing, max_speed = self.mode == status.LANDING, config.limits.max_speed
        descent = -min(config.descent, max_speed) if landing else 0.0
        if motion is None:
            return np.array([0.0, 0.0, descent, math.nan]), status.NONE
        if self.mode == status.FLYING:
            if desired is None:
                return np.full(4, math.nan), status.NONE
            limited, limit = limit_velocity(desired[:3], motion, near, config.limits, landing=False)
            return np.append(limit_speed(limited, max_speed), desired[3]), limit
        offset = np.zeros(3) if math.isnan(self.p_WH[0]) else self.p_WH - motion.p_WB  # [m]
        back = limit_speed(_HOLDING_GAIN * offset, RETURN_SPEED)
        if landing:
            back[2] = descent
        limited, _ = limit_velocity(back, motion, near, config.limits, landing)
        return np.append(limit_speed(limited, min(max_speed, RETURN_SPEED)), math.nan), status.NONE


MAX_STATUS_AGE = 1.0  # [s] Max age of a vehicle's status.

_INPUTS = {
    **{"state": 13, "measured_state": 13, "velocity_setpoint": 4, "command": 4},
    **{"state_age": 1, "observation_age": 1, "body_age": 1, "lag": 1, "policy_failed": 1},
    **{"vehicle_status": 2, "vehicle_status_age": 1, "clearance": 1, "gradient": 3},
    "unix_time": 1,
}
_AGES = {
    status.STATE_OLD: "state_age",
    status.OBSERVATION_OLD: "observation_age",
    status.BODY_LOST: "body_age",
}


class Failsafe(LeafSystem):
    """Passes the commands of a policy and its controller, within limits; if they or their inputs
    are faulty it brakes and hovers, and then lands.

    .. pydrake_system::

        name: Failsafe
        input_ports: [state, measured_state, velocity_setpoint, command, state_age, observation_age,
            body_age, lag, policy_failed, vehicle_status, vehicle_status_age, clearance, gradient,
            unix_time]
        output_ports: [velocity_setpoint, command, mode, state_is_known, is_ready, in_charge]

    - ``state``, ``measured_state`` (13 each): predicted for now, and as measured.
    - ``velocity_setpoint`` (4): v_WB [m/s] and heading [rad] or NaN; without it only the limits of
      commands hold. ``command`` (4): thrust over mass [m/s^2], body rates [rad/s].
    - ``state_age`` (1), and optionally ``observation_age``, ``body_age`` (1 each) [s]: since each
      was sent, the last by motion capture; infinite before the first.
    - Optionally ``lag`` (1) [s] of the process behind the wall clock, and ``policy_failed`` (1): 1
      while the policy raises exceptions.
    - ``vehicle_status`` (2), ``vehicle_status_age`` (1) [s], optional: see ``lcmt_vehicle_status``;
      without them the failsafe is always in charge.
    - ``clearance`` (1) [m], ``gradient`` (3), optional: from the collision sphere to the nearest
      known obstacle, and the direction away from it; NaN and 0 if none is known.
    - ``unix_time`` (1) [s], optional: see `UnixClock`; the Context's time stops in a lag.
    - ``mode`` (2): mode and reason, constants of ``lcmt_bridge_status``.
    - ``state_is_known`` (1): 1 if body rates can be flown by the state, which is at most 0.1 s old.
    - ``is_ready`` (1): 0 in the mode WAITING, else 1.
    - ``in_charge`` (1): 1 while an armed vehicle obeys, by a status of the last 1 s, else 0.

    Outputs react to a fault at once; modes change every ``period`` from time 0. WAITING is for the
    first state and observation. FLYING becomes HOLDING at a fault, and FLYING again after
    ``recovery`` without any. After ``patience`` in charge HOLDING becomes LANDING, which remains
    until the vehicle says that it does not obey any more. A vehicle that does not obey yet may be
    below its box, to take off.
    """

    def __init__(
        self,
        config: FailsafeConfig,
        controller: FlatnessControllerConfig,
        vehicle: QuadrotorParams,
        lower_W: np.ndarray,
        upper_W: np.ndarray,
        field: Distances | None = None,
    ):
        """Constructs the system, for a box (3,) [m], if `config` has no geofence, and distances to
        known obstacles. `controller` flies velocities; its limits hold for commands."""
        super().__init__()
        config.validate()
        self._config, self._controller, self._vehicle = config, controller, vehicle
        fence = config.limits.geofence or (lower_W, upper_W)
        self._field, self._box = field, Box(*np.array(fence, dtype=float))
        for name, size in _INPUTS.items():
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.hstack(Modes()))
        self.DeclareDiscreteState(np.hstack(Track()))
        producer = ValueProducer(
            allocate=lambda: AbstractValue.Make(object()), calc=weak_callback(self._calc_flown)
        )
        self._cache = self.DeclareCacheEntry(
            "velocity setpoint (4), mode and reason", producer, {self.all_sources_ticket()}
        ).cache_index()
        self._declare("velocity_setpoint", 4, lambda context: self._flown(context)[0])
        self._declare("command", 4, self._command)
        self._declare("mode", 2, self._mode)
        self._declare("state_is_known", 1, self._state_is_known)
        self._declare("is_ready", 1, self._is_ready)
        self._declare("in_charge", 1, lambda context: self._is_in_charge(context) or False)
        self.DeclarePeriodicDiscreteUpdateEvent(controller.period, 0.0, self._update)

    def _declare(self, name: str, size: int, value: Callable[[Context], Any]) -> None:
        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(np.atleast_1d(value(context)).astype(float))

        self.DeclareVectorOutputPort(name, size, calc)

    # Inputs.

    def _number(self, name: str, context: Context, default: float) -> float:
        value = optional_input(self, name, context)
        return default if value is None else float(value[0])

    def _signals(self, context: Context) -> Signals:
        track = Track.read(context)
        has_measured = self.GetInputPort("measured_state").HasValue(context)
        return Signals(
            ages={
                fault: self._number(name, context, math.nan)
                for fault, name in _AGES.items()
                if self.GetInputPort(name).HasValue(context)
            },
            unchanged=context.get_time() - track.changed if has_measured else 0.0,
            jumped=bool(track.jumped),
            lag=self._number("lag", context, 0.0),
            state=QuadrotorState.of(vector_input(self, "state", context)),
            policy_failed=bool(self._number("policy_failed", context, 0.0)),
            setpoint=optional_input(self, "velocity_setpoint", context),
            command=vector_input(self, "command", context),
        )

    def _fault(self, signals: Signals, context: Context) -> int:
        box = self._box
        if not (Modes.read(context).in_charge or self._is_in_charge(context)):
            box = Box(np.append(box.lower_W[:2], -math.inf), box.upper_W)
        return signals.fault(self._config, self._controller, box)

    def _is_in_charge(self, context: Context) -> bool | None:
        """Checks if an armed vehicle obeys; None if unknown."""
        names = "vehicle_status", "vehicle_status_age"
        vehicle, age = (optional_input(self, name, context) for name in names)
        if vehicle is None or age is None:
            return True
        return bool(vehicle.all()) if age[0] <= MAX_STATUS_AGE else None

    # Modes.

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, modes, signals = context.get_time(), Modes.read(context), self._signals(context)
        measured, age = optional_input(self, "measured_state", context), signals.ages
        if measured is not None and not math.isinf(age[status.STATE_OLD]):
            epoch, max_gap = self._number("unix_time", context, now) - now, self._config.max_age
            in_charge = bool(modes.in_charge) and self._is_in_charge(context) is not False
            times = age[status.STATE_OLD], now, max_gap, epoch
            track = Track.read(context).after(measured, *times, in_charge)
            discrete_state.set_value(1, np.hstack(track))
        waits = any(map(math.isinf, age.values()))
        is_idle = waits and modes.mode == status.WAITING
        fault = status.NONE if is_idle else self._fault(signals, context)
        modes = modes.after(fault, waits, self._is_in_charge(context), now, self._config)
        is_valid = signals.state_is_valid(self._config.max_age)
        modes = modes.hold(signals.state if is_valid else None)
        discrete_state.set_value(0, np.hstack(modes))

    # Outputs.

    def _calc_flown(self, context: Context, value: Any) -> None:
        modes, signals, config = Modes.read(context), self._signals(context), self._config
        if modes.mode == status.FLYING and (fault := self._fault(signals, context)):
            modes = modes._replace(mode=status.HOLDING, reason=fault)
        motion = None
        if signals.state_is_valid(config.max_age):
            age = signals.ages[status.STATE_OLD]
            # The content of a frozen state is older than its message.
            unpredicted = max(signals.unchanged - age, 0.0)
            deceleration, law = config.limits.deceleration, self._controller
            motion = Motion.predict(*signals.state[:2], age, unpredicted, deceleration, law)
        gradient = optional_input(self, "gradient", context)
        gradient = np.zeros(3) if gradient is None else gradient
        clearance = self._number("clearance", context, math.nan)
        near = Surroundings(clearance, gradient, self._box, self._field, self._vehicle.radius)
        setpoint, limit = modes.setpoint(signals.setpoint, motion, near, config)
        value.set_value((setpoint, int(modes.mode), int(modes.reason) or limit))

    def _flown(self, context: Context) -> tuple[np.ndarray, int, int]:
        """Returns the velocity setpoint (4,), mode and reason."""
        return cast(Any, self.get_cache_entry(self._cache).Eval(context))

    def _command(self, context: Context) -> np.ndarray:
        setpoint, mode, reason = self._flown(context)
        state, vehicle = vector_input(self, "state", context), self._vehicle
        if mode == status.FLYING and reason == status.NONE:
            return vector_input(self, "command", context)
        if not np.isfinite(state).all():
            return np.array([vehicle.gravity, 0.0, 0.0, 0.0])
        a_WB = tracking_acceleration(QuadrotorState.of(state).v_WB, setpoint[:3])
        motion_W = setpoint[:3] if mode == status.FLYING else np.zeros(3)
        return flatness_command(state, a_WB, motion_W, setpoint[3], self._controller, vehicle)

    def _is_ready(self, context: Context) -> bool:
        return Modes.read(context).mode != status.WAITING

    def _mode(self, context: Context) -> tuple[int, int]:
        waiting = status.WAITING, status.NONE
        return self._flown(context)[1:] if self._is_ready(context) else waiting

    def _state_is_known(self, context: Context) -> bool:
        max_age = min(LONGEST_PREDICTION, self._config.max_age)
        return self._is_ready(context) and self._signals(context).state_is_valid(max_age)


class FiniteVector(LeafSystem):
    """Passes the input ``signal`` to the output ``finite``, or ``substitute`` in all elements if
    any of the signal is not finite."""

    def __init__(self, size: int, substitute: float = 0.0):
        super().__init__()
        self._substitute = substitute
        signal = self.DeclareVectorInputPort("signal", size)
        self.DeclareVectorOutputPort("finite", size, self._calc, {signal.ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        signal = vector_input(self, "signal", context)
        finite = bool(np.isfinite(signal).all())
        output.SetFromVector(signal if finite else np.full(len(signal), self._substitute))
