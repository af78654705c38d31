"""Failsafe: what is flown if policy, state or observation cannot be trusted."""

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
from splatpilot.systems.common.drake import input_port, optional_input, output_port, weakly
from splatpilot.systems.messaging.flight_limits import (
    LEVEL,
    RETURN_SPEED,
    FlightLimits,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
    stopping_displacement,
)
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity import RESPONSE_TIME, tracking_acceleration
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, flatness_command
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams
from splatpilot.systems.vehicle.state import LONGEST_PREDICTION, QuadrotorState, predict_state


@dataclass
class FailsafeConfig:
    """When a vehicle is taken from its policy, and what happens then."""

    # [s] Nothing is flown by a state, an observation or a sight by motion capture that is older.
    max_age: float = 0.3
    # [s] By which a process may be behind the wall clock.
    max_lag: float = 0.3
    # [s] That all must be well again until the policy flies on.
    recovery: float = 0.5
    # [s] Of hovering after which the vehicle lands.
    patience: float = 5.0
    # [m/s] Of landing.
    descent: float = 0.5
    limits: FlightLimits = field(default_factory=FlightLimits)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("max_age", "max_lag", "recovery", "patience", "descent"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(
                    f"failsafe.{name} is {value}; it must be positive and finite, as "
                    f"{getattr(type(self), name)}"
                )
        self.limits.validate()


_SLACK = 1.01  # [-] by which a command may exceed what its controller is limited to.

SEVERITY = (
    *(status.STATE_OLD, status.STATE_FROZEN, status.STATE_JUMPED, status.BODY_LOST),
    *(status.TILTED, status.OVERRUN, status.OUTSIDE, status.OBSERVATION_OLD),
    *(status.POLICY_FAILED, status.NOT_FINITE, status.OUT_OF_BOUNDS, status.NONE),
)
"""Reasons not to fly as a policy decides, the most severe first: those for which the vehicle does
not know where it is, for which it is in danger, and for which it does not know where to fly."""


class Box(NamedTuple):
    """Where a vehicle may fly."""

    lower_W: np.ndarray  # (3,) [m]
    upper_W: np.ndarray  # (3,) [m]


class Signals(NamedTuple):
    """What is flown by, at one instant."""

    ages: dict[int, float]
    """[s] by the reasons of `lcmt_bridge_status` for not flying by what is too old."""
    unchanged: float
    """[s] since the content of the measured state changed."""
    jumped: bool
    """Whether the measured state does not follow from those before."""
    lag: float
    """[s] by which the process is behind the wall clock."""
    state: QuadrotorState
    policy_failed: bool
    """Whether the policy raised an exception instead of deciding."""
    setpoint: np.ndarray | None
    """(4,) velocity [m/s], W frame, and heading [rad], which may be NaN; None if commands alone
    are sent."""
    command: np.ndarray
    """(4,) thrust over mass [m/s^2] and body rates [rad/s]."""


def most_severe(*reasons: int) -> int:
    """The most severe of some reasons of `lcmt_bridge_status` not to fly as a policy decides."""
    return min(reasons, key=SEVERITY.index)


def state_is_wrong(signals: Signals, config: FailsafeConfig) -> bool:
    """Checks whether the state is too old, frozen or has jumped, so that nothing can be flown by
    it."""
    recent = signals.ages[status.STATE_OLD] <= config.max_age
    return not recent or signals.unchanged > config.max_age or signals.jumped


def what_is_wrong(
    signals: Signals, config: FailsafeConfig, law: FlatnessControllerConfig, box: Box
) -> int:
    """
    The most severe reason of `lcmt_bridge_status` not to fly as a policy decides, or NONE.

    Args:
        law: whose limits the command must keep.
        box: in which the vehicle must be, unless it is told commands alone: who sends these is in
            charge of no place.
    """
    setpoint, command, p_WB = signals.setpoint, signals.command, signals.state.p_WB
    max_rates = np.array([law.max_tilt_rate, law.max_tilt_rate, law.max_yaw_rate])
    wrong = {reason: not age <= config.max_age for reason, age in signals.ages.items()} | {
        status.STATE_FROZEN: signals.unchanged > config.max_age,
        status.STATE_JUMPED: signals.jumped,
        status.OVERRUN: signals.lag > config.max_lag,
        status.POLICY_FAILED: signals.policy_failed,
        status.NOT_FINITE: not np.isfinite(command).all(),
        status.OUT_OF_BOUNDS: not 0.0 <= command[0] <= _SLACK * law.max_thrust
        or bool((np.abs(command[1:]) > _SLACK * max_rates).any()),
        status.TILTED: signals.state.tilt > config.limits.max_tilt,
    }
    if setpoint is not None:
        heading_is_valid = abs(setpoint[3]) != math.inf
        wrong[status.NOT_FINITE] |= not (np.isfinite(setpoint[:3]).all() and heading_is_valid)
        wrong[status.OUTSIDE] = bool(((p_WB < box.lower_W) | (p_WB > box.upper_W)).any())
    return most_severe(status.NONE, *(reason for reason, is_so in wrong.items() if is_so))


_STOPPED = 0.3  # [m/s], below which a position is held instead of braking.
_HOLDING_GAIN = 1.0  # [1/s], with which the vehicle returns to it.

_POSITION_JUMP = 0.3  # [m] by which a position may differ from where velocities have led, and
_TURN_JUMP = 0.3  # [rad] an attitude from what angular velocities have made of it, beside
_TIME_ERROR = 0.1  # [s] of either, by which times of measurement may be wrong.
_FORGETTING = 0.5  # [s], time constant with which such differences fade.


class Memory(NamedTuple):
    """The modes in the discrete state of a `Failsafe`: numbers, as Drake has it."""

    mode: float = status.WAITING
    reason: float = status.NONE
    since: float = 0.0  # [s], when the mode began or, later, the failsafe came in charge.
    well: float = math.nan  # [s], since when all has been well.
    x: float = math.nan  # [m], the position that is held, NaN while there is none.
    y: float = math.nan
    z: float = math.nan
    in_charge: float = 0.0  # As the vehicle said last.

    def after(
        self, wrong: int, waits: bool, in_charge: bool | None, now: float, config: FailsafeConfig
    ) -> "Memory":
        """
        Gives the memory after another period.

        Args:
            wrong: what is, a reason of `lcmt_bridge_status`.
            waits: whether something has never come.
            in_charge: whether a vehicle flies by what is commanded; None if that is unknown. Who
                was in charge may be still, and lands a vehicle that is not heard any more.
            now: [s].
        """
        well = math.nan if wrong or waits else (now if math.isnan(self.well) else self.well)
        if in_charge is None:
            in_charge = bool(self.in_charge)
        memory = self._replace(well=well, in_charge=in_charge)
        if self.mode == status.WAITING:
            return memory if waits else memory._begun(status.FLYING, status.NONE, now)
        if self.mode == status.FLYING:
            return memory._begun(status.HOLDING, wrong, now) if wrong else memory
        if self.mode == status.LANDING and not in_charge:
            return memory._begun(status.HOLDING, wrong or int(self.reason), now)
        memory = memory._replace(reason=most_severe(wrong, int(self.reason)))
        if self.mode == status.HOLDING:
            if now - well >= config.recovery:
                return memory._begun(status.FLYING, status.NONE, now)
            if not in_charge:
                return memory._replace(since=now)
            if now - self.since > config.patience:
                return memory._replace(mode=status.LANDING, since=now)
        return memory

    def holding(self, state: QuadrotorState | None) -> "Memory":
        """Adds the position that is held, once the vehicle has come to rest there; without a state
        that is known there is none."""
        if state is None:
            return self._replace(x=math.nan, y=math.nan, z=math.nan)
        is_flying, has_position = self.mode == status.FLYING, not math.isnan(self.x)
        if is_flying or has_position or not np.linalg.norm(state.v_WB) < _STOPPED:
            return self
        x, y, z = state.p_WB
        return self._replace(x=x, y=y, z=z)

    def return_velocity(self, p_WB: np.ndarray) -> np.ndarray:
        """The velocity (3,) [m/s] from p_WB (3,) [m] to the position that is held; 0 without
        one."""
        if math.isnan(self.x):
            return np.zeros(3)
        held = np.array([self.x, self.y, self.z])
        return limit_speed(_HOLDING_GAIN * (held - p_WB), RETURN_SPEED)

    def _begun(self, mode: int, reason: int, now: float) -> "Memory":
        return self._replace(
            mode=mode, reason=reason, since=now, x=math.nan, y=math.nan, z=math.nan
        )


class Track(NamedTuple):
    """How measured states follow one another, in the discrete state of a `Failsafe`."""

    time: float = -math.inf  # [s], when the last state of another content was measured,
    changed: float = 0.0  # [s], and when it was seen.
    jumped: float = 0.0  # Whether it does not follow from those before.
    state: np.ndarray = np.full(13, math.nan)
    expected: np.ndarray = np.full(13, math.nan)
    """A state where and as it is turned as the velocities and body rates have led."""

    @classmethod
    def from_vector(cls, vector: np.ndarray) -> "Track":
        """The inverse of `to_vector`."""
        time, changed, jumped = vector[:3]
        return cls(time, changed, jumped, vector[3:16], vector[16:])

    def to_vector(self) -> np.ndarray:
        """The fields in one vector (29,)."""
        return np.hstack(self)

    def after(self, state: np.ndarray, time: float, now: float, max_gap: float) -> "Track":
        """
        Gives the track with the state that is there now.

        It has jumped if it is not where the velocities of the states have led, or not turned as
        their angular velocities say. Small differences fade, a jump remains one until the state
        comes back: what a map says of its place is not true any more.

        Args:
            state: (13,).
            time: [s] when it was measured.
            now: [s].
            max_gap: [s] between measurements, beyond which nothing follows from those before.
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
        alike = float(q_WB.dot(new.q_WB))
        moved = np.linalg.norm(new.p_WB - p_WB)
        turned = 2.0 * math.acos(min(abs(alike), 1.0))
        speed = max(np.linalg.norm(each.v_WB) for each in (old, new))
        rate = max(np.linalg.norm(each.w_WB_B) for each in (old, new))
        jumped = moved > _POSITION_JUMP + speed * _TIME_ERROR or turned > _TURN_JUMP + rate * max(
            duration, _TIME_ERROR
        )
        if not jumped:
            p_WB += duration / _FORGETTING * (new.p_WB - p_WB)
            q_WB += duration / _FORGETTING * (math.copysign(1.0, alike) * new.q_WB - q_WB)
            q_WB /= np.linalg.norm(q_WB)
        return Track(time, now, float(jumped), state, expected)


class Surroundings(NamedTuple):
    """What a vehicle must keep away from."""

    clearance: float
    """[m] from its collision sphere to the nearest known obstacle; NaN if none is known."""
    gradient: np.ndarray
    """(3,) The direction away from that, of any length; 0 if none is known."""
    box: Box
    """In which the collision sphere stays."""
    field: Distances | None
    """What is known of the world, for what lies ahead."""


class Motion(NamedTuple):
    """Where a vehicle is, and where it comes to rest."""

    p_WB: np.ndarray
    """(3,) [m]"""
    stop: np.ndarray
    """(3,) [m] from there to the point of rest."""
    reaction_time: float
    """[s] Time constant with which the point of rest may approach an obstacle."""

    @classmethod
    def predict(
        cls,
        p_WB: np.ndarray,
        v_WB: np.ndarray,
        age: float,
        unpredicted: float,
        deceleration: float,
        law: FlatnessControllerConfig,
    ) -> "Motion":
        """
        Predicts where a vehicle comes to rest that is flown by an old state.

        A command takes effect after a dead time: the age of the state, the lag of the attitude, and
        the period for which commands are held. See `limit_approach`.

        Args:
            p_WB, v_WB: (3,) [m], [m/s].
            age: [s] since the state was measured, up to which it was predicted.
            unpredicted: [s] by which it is older than that.
            deceleration: [m/s^2].
            law: that flies the velocities.
        """
        stop = stopping_displacement(v_WB, RESPONSE_TIME, deceleration)
        dead_time = max(age, 0.0) + unpredicted + 1.0 / law.tilt_gain + law.period
        return cls(p_WB, stop + unpredicted * v_WB, math.e * dead_time)


def flown_setpoint(
    mode: int,
    desired: np.ndarray | None,
    motion: Motion | None,
    memory: Memory,
    near: Surroundings,
    config: FailsafeConfig,
) -> tuple[np.ndarray, int]:
    """
    Computes what is flown in a mode: velocity [m/s], W frame, and heading [rad] or NaN (4,), and
    the limit, a reason of `lcmt_bridge_status` or NONE, for which it is not what is desired.

    Args:
        desired: (4,) by the policy; None if it is flown by commands alone.
        motion: of the vehicle; None if its state cannot be trusted.
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
    back = memory.return_velocity(motion.p_WB)
    if landing:
        back[2] = descent
    limited, _ = limit_velocity(back, motion, near, config.limits, landing)
    return np.append(limit_speed(limited, min(max_speed, RETURN_SPEED)), math.nan), status.NONE


def limit_velocity(
    desired: np.ndarray, motion: Motion, near: Surroundings, limits: FlightLimits, landing: bool
) -> tuple[np.ndarray, int]:
    """
    Limits a velocity (3,) [m/s], and gives the last limit, a reason of `lcmt_bridge_status` or
    NONE, that changed it.

    Args:
        desired: (3,) [m/s], W frame.
        landing: whether it may leave the box downwards, and come down on what is level.
    """
    slow = limit_speed(desired, limits.max_speed)
    away, room = np.zeros(3), math.inf
    if not math.isnan(near.clearance) and near.gradient.any():
        away = near.gradient / np.linalg.norm(near.gradient)
        if not (landing and away[2] > LEVEL):
            room = near.clearance - limits.min_clearance + float(motion.stop.dot(away))
    clear = limit_approach(slow, away, room, motion.reaction_time)
    lower, upper = near.box.lower_W + VEHICLE_RADIUS, near.box.upper_W - VEHICLE_RADIUS
    if landing:
        lower[2] = -math.inf
    rest = motion.p_WB + motion.stop
    inside = limit_to_box(clear, rest, lower, upper, motion.reaction_time)
    flown = inside
    # Last, because what leads along a fence or an obstacle may lead into another.
    if near.field is not None and not landing:
        flown = limit_ahead(
            inside, *motion[:2], near.field, limits.min_clearance, motion.reaction_time
        )
    for before, after, reason in (
        (inside, flown, status.LIMITED_CLEARANCE),
        (clear, inside, status.LIMITED_GEOFENCE),
        (slow, clear, status.LIMITED_CLEARANCE),
        (desired, slow, status.LIMITED_SPEED),
    ):
        if not np.array_equal(before, after):
            return flown, reason
    return flown, status.NONE


MAX_STATUS_AGE = 1.0
"""[s] Max age of what a vehicle says of who flies it."""


class Failsafe(LeafSystem):
    """Passes what a policy and its controller decide, within limits; if they or what they see
    cannot be trusted it brakes and hovers, and then lands.

    .. pydrake_system::

        name: Failsafe
        input_ports:
        - state
        - measured_state
        - velocity_setpoint
        - command
        - state_age
        - observation_age
        - body_age
        - lag
        - policy_failed
        - vehicle_status
        - vehicle_status_age
        - clearance
        - gradient
        output_ports:
        - velocity_setpoint
        - command
        - mode
        - state_is_known
        - is_ready
        - in_charge

    - ``state``, ``measured_state`` (13 each): of now, and as it was measured.
    - ``velocity_setpoint`` (4): v [m/s], W frame, and heading [rad] or NaN; limits are those of
      commands alone where it is not connected.
    - ``command`` (4): thrust over mass [m/s^2], body rates [rad/s].
    - ``state_age``, ``observation_age``, ``body_age`` (1 each) [s]: since each was sent, infinite
      before the first; the latter two, of what is flown by and of the last sight by motion capture,
      are optional.
    - ``lag`` (1) [s], optional: by which the process is behind the wall clock.
    - ``policy_failed`` (1), optional: 1 while the policy raises exceptions instead of deciding.
    - ``vehicle_status`` (2), ``vehicle_status_age`` (1) [s], optional: see ``lcmt_vehicle_status``;
      without them the failsafe is always in charge.
    - ``clearance`` (1) [m], ``gradient`` (3), optional: from the collision sphere to the nearest
      known obstacle, and the direction away from it; NaN and 0 if none is known.
    - ``mode`` (2): mode and reason, constants of ``lcmt_bridge_status``.
    - ``state_is_known`` (1): whether body rates can be flown by the state, which must be no older
      than 0.1 s for that, and have changed since. Velocity setpoints need not: while the state is
      unknown they are those to stop, or to descend.
    - ``is_ready`` (1): 0 while the mode is WAITING, else 1.
    - ``in_charge`` (1): 1 while an armed vehicle flies by what is commanded, as its last status
      says; 0 if that is older than 1 s, or before the first.

    What is wrong is wrong at once, in what goes out; modes change every ``period`` from time 0.
    WAITING is for the first state and observation; FLYING becomes HOLDING if anything is wrong
    and FLYING again when all has been well for ``recovery``; after ``patience`` in charge it is
    LANDING, and remains so until the vehicle says that it does not fly by this any more. A vehicle
    that is not flown yet may stand below its box, from where it takes off.
    """

    state_input_port = input_port("state")
    measured_state_input_port = input_port("measured_state")
    velocity_setpoint_input_port = input_port("velocity_setpoint")
    command_input_port = input_port("command")
    state_age_input_port = input_port("state_age")
    observation_age_input_port = input_port("observation_age")
    body_age_input_port = input_port("body_age")
    lag_input_port = input_port("lag")
    policy_failed_input_port = input_port("policy_failed")
    vehicle_status_input_port = input_port("vehicle_status")
    vehicle_status_age_input_port = input_port("vehicle_status_age")
    clearance_input_port = input_port("clearance")
    gradient_input_port = input_port("gradient")
    velocity_setpoint_output_port = output_port("velocity_setpoint")
    command_output_port = output_port("command")
    mode_output_port = output_port("mode")
    state_is_known_output_port = output_port("state_is_known")
    is_ready_output_port = output_port("is_ready")
    in_charge_output_port = output_port("in_charge")

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
            config: when, and what then.
            controller: the law that flies velocities; commands may not exceed its limits.
            vehicle: that is flown.
            lower_W, upper_W: (3,) [m] corners of the box in which it stays, unless `config.limits`
                has one.
            field: what is known of the world, for what lies ahead.

        Raises:
            ValueError: on a configuration out of range.
        """
        super().__init__()
        config.validate()
        self._field = field
        self._config, self._controller, self._vehicle = config, controller, vehicle
        fence = config.limits.geofence or (lower_W, upper_W)
        self._box = Box(*(np.asarray(corner, dtype=float) for corner in fence))
        for name, size in (
            *(("state", 13), ("measured_state", 13), ("velocity_setpoint", 4), ("command", 4)),
            *((name, 1) for name in ("state_age", "observation_age", "body_age", "lag")),
            *(("policy_failed", 1), ("vehicle_status", 2), ("vehicle_status_age", 1)),
            *(("clearance", 1), ("gradient", 3)),
        ):
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.array(Memory()))
        self.DeclareDiscreteState(Track().to_vector())
        flown = self.DeclareCacheEntry(
            "velocity setpoint (4), mode and reason",
            ValueProducer(
                allocate=lambda: AbstractValue.Make(object()),
                calc=weakly(self._calc_flown),
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

    def _state(self, context: Context) -> QuadrotorState:
        return QuadrotorState.of(np.asarray(self.GetInputPort("state").Eval(context)))

    def _ages(self, context: Context) -> dict[int, float]:
        """[s], by the reasons for not flying by what is older than allowed."""
        ports = {
            status.STATE_OLD: "state_age",
            status.OBSERVATION_OLD: "observation_age",
            status.BODY_LOST: "body_age",
        }
        read = {reason: optional_input(self, name, context) for reason, name in ports.items()}
        return {reason: float(age[0]) for reason, age in read.items() if age is not None}

    def _signals(self, context: Context) -> Signals:
        lag, failed = (optional_input(self, name, context) for name in ("lag", "policy_failed"))
        track = _track(context)
        measured = self.GetInputPort("measured_state").HasValue(context)
        return Signals(
            ages=self._ages(context),
            unchanged=context.get_time() - track.changed if measured else 0.0,
            jumped=bool(track.jumped),
            lag=0.0 if lag is None else float(lag[0]),
            state=self._state(context),
            policy_failed=failed is not None and bool(failed[0]),
            setpoint=optional_input(self, "velocity_setpoint", context),
            command=np.asarray(self.GetInputPort("command").Eval(context)),
        )

    def _wrong(self, context: Context) -> int:
        """The most severe reason not to fly as the policy decides, or NONE."""
        box = self._box
        if not (_memory(context).in_charge or self._is_in_charge(context)):
            box = Box(np.append(box.lower_W[:2], -math.inf), box.upper_W)
        return what_is_wrong(self._signals(context), self._config, self._controller, box)

    def _is_in_charge(self, context: Context) -> bool | None:
        """Whether a vehicle flies by what is commanded; None if that is unknown."""
        told, age = (
            optional_input(self, name, context) for name in ("vehicle_status", "vehicle_status_age")
        )
        if told is None or age is None:
            return True
        return bool(told.all()) if age[0] <= MAX_STATUS_AGE else None

    def _known(self, context: Context) -> bool:
        return not state_is_wrong(self._signals(context), self._config)

    def _mode(self, context: Context) -> tuple[int, int]:
        """Mode and reason at this instant."""
        memory = _memory(context)
        mode, reason = int(memory.mode), int(memory.reason)
        if mode != status.FLYING:
            return mode, reason
        wrong = self._wrong(context)
        return (status.HOLDING, wrong) if wrong else (mode, status.NONE)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, memory, ages = context.get_time(), _memory(context), self._ages(context)
        measured = optional_input(self, "measured_state", context)
        if measured is not None and not math.isinf(ages[status.STATE_OLD]):
            time = now - ages[status.STATE_OLD]
            track = _track(context).after(measured, time, now, self._config.max_age)
            discrete_state.set_value(1, track.to_vector())
        waits = any(map(math.isinf, ages.values()))
        idle = waits and memory.mode == status.WAITING
        wrong = status.NONE if idle else self._wrong(context)
        memory = memory.after(wrong, waits, self._is_in_charge(context), now, self._config)
        memory = memory.holding(self._state(context) if self._known(context) else None)
        discrete_state.set_value(0, np.array(memory))

    def _motion(self, context: Context) -> Motion | None:
        """Where the vehicle is and comes to rest; None if its state cannot be trusted."""
        signals = self._signals(context)
        if state_is_wrong(signals, self._config):
            return None
        age = signals.ages[status.STATE_OLD]
        return Motion.predict(
            *signals.state[:2],
            age,
            # The content of a state that has frozen is older than its message.
            max(signals.unchanged - age, 0.0),
            self._config.limits.deceleration,
            self._controller,
        )

    def _calc_flown(self, context: Context, value: Any) -> None:
        mode, reason = self._mode(context)
        clearance, gradient = (
            optional_input(self, name, context) for name in ("clearance", "gradient")
        )
        near = Surroundings(
            math.nan if clearance is None else float(clearance[0]),
            np.zeros(3) if gradient is None else gradient,
            self._box,
            self._field,
        )
        desired = optional_input(self, "velocity_setpoint", context)
        motion, memory = self._motion(context), _memory(context)
        setpoint, limit = flown_setpoint(mode, desired, motion, memory, near, self._config)
        value.set_value((setpoint, mode, reason or limit))

    def _flown(self, context: Context) -> tuple[np.ndarray, int, int]:
        """Velocity setpoint (4,), mode and reason."""
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
        if _memory(context).mode == status.WAITING:
            output.SetFromVector(np.array([status.WAITING, status.NONE], dtype=float))
        else:
            output.SetFromVector(np.array(self._flown(context)[1:], dtype=float))

    def _calc_is_ready(self, context: Context, output: BasicVector) -> None:
        output[0] = float(_memory(context).mode != status.WAITING)

    def _calc_in_charge(self, context: Context, output: BasicVector) -> None:
        output[0] = float(self._is_in_charge(context) or False)

    def _calc_state_is_known(self, context: Context, output: BasicVector) -> None:
        signals = self._signals(context)
        age = max(signals.ages[status.STATE_OLD], signals.unchanged)
        is_ready = _memory(context).mode != status.WAITING
        output[0] = float(is_ready and age <= LONGEST_PREDICTION and self._known(context))


def _memory(context: Context) -> Memory:
    return Memory(*np.asarray(context.get_discrete_state(0).value()))


def _track(context: Context) -> Track:
    return Track.from_vector(np.asarray(context.get_discrete_state(1).value()))


class FiniteVector(LeafSystem):
    """Replaces a signal any part of which is infinite or not a number.

    .. pydrake_system::

        name: FiniteVector
        input_ports:
        - signal
        output_ports:
        - finite

    Both have the size that the constructor is given, ``finite`` is ``signal`` or ``substitute``
    throughout. Stateless.
    """

    signal_input_port = input_port("signal")
    finite_output_port = output_port("finite")

    def __init__(self, size: int, substitute: float = 0.0):
        super().__init__()
        self._substitute = substitute
        self.DeclareVectorInputPort("signal", size)
        self.DeclareVectorOutputPort("finite", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        signal = np.asarray(self.get_input_port().Eval(context))
        finite = bool(np.isfinite(signal).all())
        output.SetFromVector(signal if finite else np.full(len(signal), self._substitute))
