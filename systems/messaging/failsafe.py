"""Failsafe: limits a policy's commands, and hovers and lands without a trustworthy policy."""

import math
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
from splatpilot.systems.common.drake import optional_input, weakly
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


# Checks -------------------------------------------------------------------------------------------

SEVERITY = (
    *(status.STATE_OLD, status.STATE_FROZEN, status.STATE_JUMPED, status.BODY_LOST),
    *(status.TILTED, status.OVERRUN, status.OUTSIDE, status.OBSERVATION_OLD),
    *(status.POLICY_FAILED, status.NOT_FINITE, status.OUT_OF_BOUNDS, status.NONE),
)
"""Faults, the most severe first: unknown position, danger, unknown target."""

_TOLERANCE = 1.01  # [-] by which a command may exceed the limits of its controller.


class Signals(NamedTuple):
    """Inputs of a failsafe at one instant."""

    ages: dict[int, float]  # [s] by the fault of `lcmt_bridge_status` that a high age is.
    unchanged: float  # [s] since the content of the measured state changed.
    jumped: bool  # True if the measured state does not follow from those before.
    lag: float  # [s] of the process behind the wall clock.
    state: QuadrotorState
    policy_failed: bool  # True if the policy raised an exception.
    setpoint: np.ndarray | None
    """(4,) velocity [m/s], W frame, and heading [rad] or NaN; None if only commands are sent."""
    command: np.ndarray  # (4,) thrust over mass [m/s^2] and body rates [rad/s].


def most_severe(*reasons: int) -> int:
    """Returns the most severe of some reasons of `lcmt_bridge_status`."""
    return min(reasons, key=SEVERITY.index)


def state_is_invalid(signals: Signals, config: FailsafeConfig) -> bool:
    """Checks if the state is too old, frozen or has jumped."""
    recent = signals.ages[status.STATE_OLD] <= config.max_age
    return not recent or signals.unchanged > config.max_age or signals.jumped


def find_fault(
    signals: Signals, config: FailsafeConfig, law: FlatnessControllerConfig, box: Box
) -> int:
    """
    Returns the most severe fault, a reason of `lcmt_bridge_status`, or NONE.

    Args:
        law: controller whose limits hold for the command.
        box: that must hold the vehicle, unless only commands are sent: their sender is responsible
            for the position.
    """
    setpoint, command, p_WB = signals.setpoint, signals.command, signals.state.p_WB
    max_rates = np.array([law.max_tilt_rate, law.max_tilt_rate, law.max_yaw_rate])
    faults = {reason: not age <= config.max_age for reason, age in signals.ages.items()} | {
        status.STATE_FROZEN: signals.unchanged > config.max_age,
        status.STATE_JUMPED: signals.jumped,
        status.OVERRUN: signals.lag > config.max_lag,
        status.POLICY_FAILED: signals.policy_failed,
        status.NOT_FINITE: not np.isfinite(command).all(),
        status.OUT_OF_BOUNDS: not 0.0 <= command[0] <= _TOLERANCE * law.max_thrust
        or bool((np.abs(command[1:]) > _TOLERANCE * max_rates).any()),
        status.TILTED: signals.state.tilt > config.limits.max_tilt,
    }
    if setpoint is not None:
        heading_is_valid = abs(setpoint[3]) != math.inf
        faults[status.NOT_FINITE] |= not (np.isfinite(setpoint[:3]).all() and heading_is_valid)
        faults[status.OUTSIDE] = bool(((p_WB < box.lower_W) | (p_WB > box.upper_W)).any())
    return most_severe(status.NONE, *(reason for reason, found in faults.items() if found))


_POSITION_JUMP = 0.3  # [m] max difference of a position from the integral of velocities, and
_ROTATION_JUMP = 0.3  # [rad] of an attitude from that of angular velocities, in addition to
_TIME_ERROR = 0.1  # [s] of motion, for wrong times of measurement.
_FORGETTING = 0.5  # [s] time constant with which such differences fade.


class Track(NamedTuple):
    """The sequence of measured states, in the discrete state of a `Failsafe`."""

    time: float = -math.inf  # [s] of the measurement of the last state with new content,
    changed: float = 0.0  # [s] and of its arrival.
    jumped: float = 0.0  # 1 if it does not follow from those before.
    state: np.ndarray = np.full(13, math.nan)
    expected: np.ndarray = np.full(13, math.nan)  # state predicted by velocities and body rates.

    @classmethod
    def from_vector(cls, vector: np.ndarray) -> "Track":
        """Inverts `np.hstack`."""
        time, changed, jumped = vector[:3]
        return cls(time, changed, jumped, vector[3:16], vector[16:])

    def after(self, state: np.ndarray, time: float, now: float, max_gap: float) -> "Track":
        """
        Adds a measured state.

        It has jumped if it is not where the velocities of the states have led, or not rotated as
        their angular velocities say. Small differences fade. A jump remains one until the state
        comes back, since the map does not fit to the position any more.

        Args:
            state: (13,).
            time: [s] of its measurement.
            now: [s].
            max_gap: [s] between measurements, beyond which the sequence starts again.
        """
        if np.array_equal(state, self.state):
            return self
        duration = time - self.time
        if not 0.0 < duration <= max_gap:
            return Track(time, now, 0.0, state, state)
        old, new = QuadrotorState.of(self.state), QuadrotorState.of(state)
        p_WB, _, q_WB, _ = QuadrotorState.of(self.expected)
        mean = QuadrotorState(p_WB, (old.v_WB + new.v_WB) / 2, q_WB, (old.w_WB_B + new.w_WB_B) / 2)
        expected = predict_state(mean.to_vector(), duration)
        p_WB, _, q_WB, _ = QuadrotorState.of(expected)
        dot = float(q_WB.dot(new.q_WB))
        distance = np.linalg.norm(new.p_WB - p_WB)
        angle = 2.0 * math.acos(min(abs(dot), 1.0))
        speed = max(np.linalg.norm(each.v_WB) for each in (old, new))
        rate = max(np.linalg.norm(each.w_WB_B) for each in (old, new))
        jumped = (
            distance > _POSITION_JUMP + speed * _TIME_ERROR
            or angle > _ROTATION_JUMP + rate * max(duration, _TIME_ERROR)
        )
        if not jumped:
            p_WB += duration / _FORGETTING * (new.p_WB - p_WB)
            q_WB += duration / _FORGETTING * (math.copysign(1.0, dot) * new.q_WB - q_WB)
            q_WB /= np.linalg.norm(q_WB)
        return Track(time, now, float(jumped), state, expected)


# Modes --------------------------------------------------------------------------------------------

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
    def from_vector(cls, vector: np.ndarray) -> "Modes":
        """Inverts `np.hstack`."""
        mode, reason, since, healthy, in_charge = vector[:5]
        return cls(mode, reason, since, healthy, in_charge, vector[5:])

    def after(
        self, fault: int, waits: bool, in_charge: bool | None, now: float, config: FailsafeConfig
    ) -> "Modes":
        """
        Returns the modes after another period.

        Args:
            fault: a reason of `lcmt_bridge_status`.
            waits: True if an input has never come.
            in_charge: True if the vehicle obeys; None if unknown, which keeps the last value: a
                landing continues if the vehicle is not heard any more.
            now: [s].
        """
        healthy = (
            math.nan if fault or waits else (now if math.isnan(self.healthy) else self.healthy)
        )
        if in_charge is None:
            in_charge = bool(self.in_charge)
        modes = self._replace(healthy=healthy, in_charge=in_charge)
        if self.mode == status.WAITING:
            return modes if waits else modes._begin(status.FLYING, status.NONE, now)
        if self.mode == status.FLYING:
            return modes._begin(status.HOLDING, fault, now) if fault else modes
        if self.mode == status.LANDING and not in_charge:
            return modes._begin(status.HOLDING, fault or int(self.reason), now)
        modes = modes._replace(reason=most_severe(fault, int(self.reason)))
        if self.mode == status.HOLDING:
            if now - healthy >= config.recovery:
                return modes._begin(status.FLYING, status.NONE, now)
            if not in_charge:
                return modes._replace(since=now)
            if now - self.since > config.patience:
                return modes._replace(mode=status.LANDING, since=now)
        return modes

    def hold(self, state: QuadrotorState | None) -> "Modes":
        """Adds the held position once the vehicle is at rest; removes it without a valid state."""
        if state is None:
            return self._replace(p_WH=_NO_POSITION)
        has_position = not math.isnan(self.p_WH[0])
        if self.mode == status.FLYING or has_position or not np.linalg.norm(state.v_WB) < _STOPPED:
            return self
        return self._replace(p_WH=state.p_WB)

    def return_velocity(self, p_WB: np.ndarray) -> np.ndarray:
        """Returns the velocity (3,) [m/s] from p_WB to the held position; 0 without one."""
        if math.isnan(self.p_WH[0]):
            return np.zeros(3)
        return limit_speed(_HOLDING_GAIN * (self.p_WH - p_WB), RETURN_SPEED)

    def _begin(self, mode: int, reason: int, now: float) -> "Modes":
        return self._replace(mode=mode, reason=reason, since=now, p_WH=_NO_POSITION)


def limited_setpoint(
    mode: int,
    desired: np.ndarray | None,
    motion: Motion | None,
    modes: Modes,
    near: Surroundings,
    config: FailsafeConfig,
) -> tuple[np.ndarray, int]:
    """
    Computes the setpoint of a mode.

    Args:
        desired: (4,) setpoint of the policy; None if only commands are sent.
        motion: of the vehicle; None without a valid state.

    Returns:
        Velocity [m/s], W frame, and heading [rad] or NaN (4,), and the limit that changed the
        desired one: a reason of `lcmt_bridge_status` or NONE.
    """
    landing = mode == status.LANDING
    max_speed = config.limits.max_speed
    descent = -min(config.descent, max_speed) if landing else 0.0
    if motion is None:
        return np.array([0.0, 0.0, descent, math.nan]), status.NONE
    if mode == status.FLYING:
        if desired is None:
            return np.full(4, math.nan), status.NONE
        limited, limit = limit_velocity(desired[:3], motion, near, config.limits, landing=False)
        return np.append(limit_speed(limited, max_speed), desired[3]), limit
    back = modes.return_velocity(motion.p_WB)
    if landing:
        back[2] = descent
    limited, _ = limit_velocity(back, motion, near, config.limits, landing)
    return np.append(limit_speed(limited, min(max_speed, RETURN_SPEED)), math.nan), status.NONE


# System -------------------------------------------------------------------------------------------

MAX_STATUS_AGE = 1.0
"""[s] Max age of a vehicle's status."""

_INPUTS = {
    **{"state": 13, "measured_state": 13, "velocity_setpoint": 4, "command": 4},
    **{"state_age": 1, "observation_age": 1, "body_age": 1, "lag": 1, "policy_failed": 1},
    **{"vehicle_status": 2, "vehicle_status_age": 1, "clearance": 1, "gradient": 3},
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
            body_age, lag, policy_failed, vehicle_status, vehicle_status_age, clearance, gradient]
        output_ports: [velocity_setpoint, command, mode, state_is_known, is_ready, in_charge]

    - ``state``, ``measured_state`` (13 each): predicted for now, and as measured.
    - ``velocity_setpoint`` (4): v [m/s], W frame, and heading [rad] or NaN; without it only the
      limits of commands hold.
    - ``command`` (4): thrust over mass [m/s^2], body rates [rad/s].
    - ``state_age``, ``observation_age``, ``body_age`` (1 each) [s]: since each was sent, infinite
      before the first. The observation's and that of the last sight by motion capture are optional.
    - ``lag`` (1) [s], optional: of the process behind the wall clock.
    - ``policy_failed`` (1), optional: 1 while the policy raises exceptions.
    - ``vehicle_status`` (2), ``vehicle_status_age`` (1) [s], optional: see ``lcmt_vehicle_status``;
      without them the failsafe is always in charge.
    - ``clearance`` (1) [m], ``gradient`` (3), optional: from the collision sphere to the nearest
      known obstacle, and the direction away from it; NaN and 0 if none is known.
    - ``mode`` (2): mode and reason, constants of ``lcmt_bridge_status``.
    - ``state_is_known`` (1): 1 if body rates can be flown by the state, which must be no older than
      0.1 s, and have changed since. Velocity setpoints do not need it: without a valid state they
      are those to stop, or to descend.
    - ``is_ready`` (1): 0 in the mode WAITING, else 1.
    - ``in_charge`` (1): 1 while an armed vehicle obeys, by its last status; 0 if that is older than
      1 s, or before the first.

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
        """Constructs the system.

        Args:
            config: thresholds, timing and limits.
            controller: law that flies velocities; its limits hold for commands.
            vehicle: its parameters.
            lower_W, upper_W: (3,) [m] corners of the box that holds it, unless `config.limits` has
                one.
            field: distances to known obstacles, to check the path.
        """
        super().__init__()
        config.validate()
        self._field = field
        self._config, self._controller, self._vehicle = config, controller, vehicle
        fence = config.limits.geofence or (lower_W, upper_W)
        self._box = Box(*(np.asarray(corner, dtype=float) for corner in fence))
        for name, size in _INPUTS.items():
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.hstack(Modes()))
        self.DeclareDiscreteState(np.hstack(Track()))
        flown = self.DeclareCacheEntry(
            "velocity setpoint (4), mode and reason",
            ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=weakly(self._calc_flown)
            ),
            {self.all_sources_ticket()},
        )
        self._cache = flown.cache_index()
        self.DeclareVectorOutputPort("velocity_setpoint", 4, self._calc_velocity_setpoint)
        self.DeclareVectorOutputPort("command", 4, self._calc_command)
        self.DeclareVectorOutputPort("mode", 2, self._calc_mode)
        self.DeclareVectorOutputPort("state_is_known", 1, self._calc_state_is_known)
        self.DeclareVectorOutputPort("is_ready", 1, self._calc_is_ready)
        self.DeclareVectorOutputPort("in_charge", 1, self._calc_in_charge)
        self.DeclarePeriodicDiscreteUpdateEvent(controller.period, 0.0, self._update)

    # Inputs.

    def _ages(self, context: Context) -> dict[int, float]:
        read = {fault: optional_input(self, name, context) for fault, name in _AGES.items()}
        return {fault: float(age[0]) for fault, age in read.items() if age is not None}

    def _signals(self, context: Context) -> Signals:
        lag, failed = (optional_input(self, name, context) for name in ("lag", "policy_failed"))
        track = _track(context)
        measured = self.GetInputPort("measured_state").HasValue(context)
        return Signals(
            ages=self._ages(context),
            unchanged=context.get_time() - track.changed if measured else 0.0,
            jumped=bool(track.jumped),
            lag=0.0 if lag is None else float(lag[0]),
            state=QuadrotorState.of(np.asarray(self.GetInputPort("state").Eval(context))),
            policy_failed=failed is not None and bool(failed[0]),
            setpoint=optional_input(self, "velocity_setpoint", context),
            command=np.asarray(self.GetInputPort("command").Eval(context)),
        )

    def _fault(self, context: Context) -> int:
        box = self._box
        if not (_modes(context).in_charge or self._is_in_charge(context)):
            box = Box(np.append(box.lower_W[:2], -math.inf), box.upper_W)
        return find_fault(self._signals(context), self._config, self._controller, box)

    def _is_in_charge(self, context: Context) -> bool | None:
        """Checks if an armed vehicle obeys; None if unknown."""
        vehicle, age = (
            optional_input(self, name, context) for name in ("vehicle_status", "vehicle_status_age")
        )
        if vehicle is None or age is None:
            return True
        return bool(vehicle.all()) if age[0] <= MAX_STATUS_AGE else None

    # Modes.

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, modes, ages = context.get_time(), _modes(context), self._ages(context)
        measured = optional_input(self, "measured_state", context)
        if measured is not None and not math.isinf(ages[status.STATE_OLD]):
            time = now - ages[status.STATE_OLD]
            track = _track(context).after(measured, time, now, self._config.max_age)
            discrete_state.set_value(1, np.hstack(track))
        waits = any(map(math.isinf, ages.values()))
        idle = waits and modes.mode == status.WAITING
        fault = status.NONE if idle else self._fault(context)
        modes = modes.after(fault, waits, self._is_in_charge(context), now, self._config)
        signals = self._signals(context)
        modes = modes.hold(None if state_is_invalid(signals, self._config) else signals.state)
        discrete_state.set_value(0, np.hstack(modes))

    # Outputs.

    def _calc_flown(self, context: Context, value: Any) -> None:
        modes, signals = _modes(context), self._signals(context)
        mode, reason = int(modes.mode), int(modes.reason)
        if mode == status.FLYING:
            reason = self._fault(context)
            mode = status.HOLDING if reason else mode
        motion = None
        if not state_is_invalid(signals, self._config):
            age = signals.ages[status.STATE_OLD]
            motion = Motion.predict(
                *signals.state[:2],
                age,
                # The content of a frozen state is older than its message.
                max(signals.unchanged - age, 0.0),
                self._config.limits.deceleration,
                self._controller,
            )
        clearance, gradient = (
            optional_input(self, name, context) for name in ("clearance", "gradient")
        )
        near = Surroundings(
            math.nan if clearance is None else float(clearance[0]),
            np.zeros(3) if gradient is None else gradient,
            self._box,
            self._field,
        )
        setpoint, limit = limited_setpoint(
            mode, signals.setpoint, motion, modes, near, self._config
        )
        value.set_value((setpoint, mode, reason or limit))

    def _flown(self, context: Context) -> tuple[np.ndarray, int, int]:
        """Returns the velocity setpoint (4,), mode and reason."""
        return cast(Any, self.get_cache_entry(self._cache).Eval(context))

    def _calc_velocity_setpoint(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._flown(context)[0])

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        setpoint, mode, reason = self._flown(context)
        if mode == status.FLYING and reason == status.NONE:
            output.SetFromVector(np.asarray(self.GetInputPort("command").Eval(context)))
            return
        state = np.asarray(self.GetInputPort("state").Eval(context))
        if not np.isfinite(state).all():
            output.SetFromVector(np.array([self._vehicle.gravity, 0.0, 0.0, 0.0]))
            return
        a_WB = tracking_acceleration(QuadrotorState.of(state).v_WB, setpoint[:3])
        motion = setpoint[:3] if mode == status.FLYING else np.zeros(3)
        law, vehicle = self._controller, self._vehicle
        output.SetFromVector(flatness_command(state, a_WB, motion, setpoint[3], law, vehicle))

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        waits = _modes(context).mode == status.WAITING
        mode = (status.WAITING, status.NONE) if waits else self._flown(context)[1:]
        output.SetFromVector(np.array(mode, dtype=float))

    def _calc_is_ready(self, context: Context, output: BasicVector) -> None:
        output[0] = float(_modes(context).mode != status.WAITING)

    def _calc_in_charge(self, context: Context, output: BasicVector) -> None:
        output[0] = float(self._is_in_charge(context) or False)

    def _calc_state_is_known(self, context: Context, output: BasicVector) -> None:
        signals = self._signals(context)
        age = max(signals.ages[status.STATE_OLD], signals.unchanged)
        is_ready = _modes(context).mode != status.WAITING
        is_valid = not state_is_invalid(signals, self._config)
        output[0] = float(is_ready and age <= LONGEST_PREDICTION and is_valid)


def _modes(context: Context) -> Modes:
    return Modes.from_vector(np.asarray(context.get_discrete_state(0).value()))


def _track(context: Context) -> Track:
    return Track.from_vector(np.asarray(context.get_discrete_state(1).value()))


class FiniteVector(LeafSystem):
    """Replaces a vector if any of its elements is not finite.

    .. pydrake_system::

        name: FiniteVector
        input_ports: [signal]
        output_ports: [finite]

    Both have the same size; ``finite`` is ``signal`` or ``substitute`` in all elements.
    """

    def __init__(self, size: int, substitute: float = 0.0):
        super().__init__()
        self._substitute = substitute
        self.DeclareVectorInputPort("signal", size)
        self.DeclareVectorOutputPort("finite", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        signal = np.asarray(self.get_input_port().Eval(context))
        finite = bool(np.isfinite(signal).all())
        output.SetFromVector(signal if finite else np.full(len(signal), self._substitute))
