"""Failsafe: what is flown where nobody can be trusted to say."""

import math
import weakref
from typing import Any, cast

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
from splatpilot.systems.messaging.failsafe_config import (
    FailsafeConfig,
    wrong_with_command,
    wrong_with_state,
)
from splatpilot.systems.messaging.failsafe_modes import Memory
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity_tracking import tracking_acceleration
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.flatness_controller import (
    FlatnessControllerConfig,
    flatness_command,
)
from splatpilot.systems.vehicle.flight_limits import (
    LEVEL,
    limit_ahead,
    limit_approach,
    limit_speed,
    limit_to_box,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS, QuadrotorParams
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

_MOVING = 0.3  # [m/s], from which on a position that stands still is none.
_HOLDING_GAIN = 1.0  # [1/s], with which the place is returned to, and
_HOLDING_SPEED = 1.0  # [m/s], the greatest speed at which.
_FAR = np.full(3, math.inf)
_PREDICTABLE = 0.1  # [s], how old states can be brought up to date for body rates.


class Failsafe(LeafSystem):
    """Lets pass what a policy and its controller want, within limits; where they or what they see
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
        - clearance
        - gradient
        output_ports:
        - velocity_setpoint
        - command
        - mode
        - state_is_known
        - in_charge

    - ``state``, ``measured_state`` (13 each): of now, and as it was measured.
    - ``velocity_setpoint`` (4): v [m/s], W frame, and heading [rad] or NaN; limits are those of
      commands alone where it is not connected.
    - ``command`` (4): thrust over mass [m/s^2], body rates [rad/s].
    - ``state_age``, ``observation_age``, ``body_age`` (1 each) [s]: since each was sent, infinite
      before the first; the latter two, of what is flown by and of the last sight by motion capture,
      are optional.
    - ``lag`` (1) [s], optional: by which the process is behind the wall clock.
    - ``clearance`` (1) [m], ``gradient`` (3), optional: from the hull to the nearest obstacle that
      is known, and the direction away from it; NaN and 0 where nothing is known.
    - ``mode`` (2): mode and reason, constants of ``lcmt_bridge_status``.
    - ``state_is_known`` (1): whether body rates can be flown by the state, which must be no older
      than 0.1 s for that. Velocity setpoints need not: while the state is unknown they are those
      to stop, or to descend.
    - ``in_charge`` (1): 0 while the mode is WAITING, else 1.

    What is wrong is wrong at once, in what goes out; modes change every ``period`` from time 0.
    WAITING is for the first state and observation; FLYING becomes HOLDING where anything is wrong
    and FLYING again when all has been well for ``recovery``; after ``patience`` it is LANDING, and
    remains so.
    """

    state_input_port = input_port("state")
    measured_state_input_port = input_port("measured_state")
    velocity_setpoint_input_port = input_port("velocity_setpoint")
    command_input_port = input_port("command")
    state_age_input_port = input_port("state_age")
    observation_age_input_port = input_port("observation_age")
    body_age_input_port = input_port("body_age")
    lag_input_port = input_port("lag")
    clearance_input_port = input_port("clearance")
    gradient_input_port = input_port("gradient")
    velocity_setpoint_output_port = output_port("velocity_setpoint")
    command_output_port = output_port("command")
    mode_output_port = output_port("mode")
    state_is_known_output_port = output_port("state_is_known")
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
        self._lower, self._upper = (np.asarray(corner, dtype=float) for corner in fence)
        for name, size in (
            *(("state", 13), ("measured_state", 13), ("velocity_setpoint", 4), ("command", 4)),
            *((name, 1) for name in ("state_age", "observation_age", "body_age", "lag")),
            *(("clearance", 1), ("gradient", 3)),
        ):
            self.DeclareVectorInputPort(name, size)
        self.DeclareDiscreteState(np.array(Memory()))
        failsafe = weakref.proxy(self)  # See `EsdfCollision`.
        flown = self.DeclareCacheEntry(
            "velocity setpoint (4), mode and reason",
            ValueProducer(
                allocate=lambda: AbstractValue.Make(object()),
                calc=lambda context, value: failsafe._calc_flown(context, value),
            ),
            {self.all_sources_ticket()},
        )
        self._cache = flown.cache_index()
        self.DeclareVectorOutputPort("velocity_setpoint", 4, self._calc_velocity_setpoint)
        self.DeclareVectorOutputPort("command", 4, self._calc_command)
        self.DeclareVectorOutputPort("mode", 2, self._calc_mode)
        self.DeclareVectorOutputPort("state_is_known", 1, self._calc_state_is_known)
        self.DeclareVectorOutputPort("in_charge", 1, self._calc_in_charge)
        self.DeclarePeriodicDiscreteUpdateEvent(controller.period, 0.0, self._update)

    def _read(self, context: Context, name: str) -> np.ndarray | None:
        port = self.GetInputPort(name)
        return np.asarray(port.Eval(context)) if port.HasValue(context) else None

    def _ages(self, context: Context) -> dict[int, float]:
        """[s], by the reasons for not flying by what is older than allowed."""
        ports = {
            status.STATE_OLD: "state_age",
            status.OBSERVATION_OLD: "observation_age",
            status.BODY_LOST: "body_age",
        }
        read = {reason: self._read(context, name) for reason, name in ports.items()}
        return {reason: float(age[0]) for reason, age in read.items() if age is not None}

    def _wrong(self, context: Context) -> int:
        """The first reason not to fly as the policy decides; NONE where there is none."""
        config, memory = self._config, _memory(context)
        for reason, age in self._ages(context).items():
            if not age <= config.max_age:
                return reason
        state = QuadrotorState.of(np.asarray(self._read(context, "state")))
        frozen = context.get_time() - memory.moved > config.max_age
        if frozen and np.linalg.norm(state.v_WB) > _MOVING:
            return status.STATE_FROZEN
        lag = self._read(context, "lag")
        if lag is not None and lag[0] > config.max_lag:
            return status.OVERRUN
        setpoint = self._read(context, "velocity_setpoint")
        command = np.asarray(self._read(context, "command"))
        wrong = wrong_with_command(setpoint, command, self._controller)
        # Who is told body rates alone is in charge of no place.
        lower, upper = (self._lower, self._upper) if setpoint is not None else (-_FAR, _FAR)
        return wrong or wrong_with_state(state, config.limits.max_tilt, lower, upper)

    def _mode(self, context: Context) -> tuple[int, int]:
        """Mode and reason at this instant."""
        memory = _memory(context)
        mode, reason = int(memory.mode), int(memory.reason)
        if mode != status.FLYING:
            return mode, reason
        wrong = self._wrong(context)
        return (status.HOLDING, wrong) if wrong else (mode, status.NONE)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        now, memory = context.get_time(), _memory(context)
        measured = self._read(context, "measured_state")
        if measured is None:
            memory = memory._replace(moved=now)
        else:
            memory = memory.seeing(measured[:3], now)
        waits = any(map(math.isinf, self._ages(context).values()))
        idle = waits and memory.mode == status.WAITING
        wrong = status.NONE if idle else self._wrong(context)
        memory = memory.after(wrong, waits, now, self._config)
        if self._known(context):
            p_WB, v_WB, _, _ = QuadrotorState.of(np.asarray(self._read(context, "state")))
            memory = memory.holding(p_WB, v_WB)
        discrete_state.set_value(np.array(memory))

    def _known(self, context: Context) -> bool:
        memory, age = _memory(context), self._ages(context)[status.STATE_OLD]
        return age <= self._config.max_age and memory.reason != status.STATE_FROZEN

    def _flown(self, context: Context) -> tuple[np.ndarray, int, int]:
        """Velocity setpoint (4,), mode and reason."""
        mode, reason = self._mode(context)
        landing = mode == status.LANDING
        descent = np.array([0.0, 0.0, -self._config.descent if landing else 0.0])
        if not self._known(context):
            return np.append(descent, math.nan), mode, reason
        state = QuadrotorState.of(np.asarray(self._read(context, "state")))
        setpoint = self._read(context, "velocity_setpoint")
        if mode == status.FLYING:
            if setpoint is None:
                return np.full(4, math.nan), mode, reason
            limited, limit = self._limited(context, setpoint[:3], state, landing=False)
            return np.append(limited, setpoint[3]), mode, limit
        back, place = np.zeros(3), _memory(context).place()
        if place is not None:
            back = limit_speed(_HOLDING_GAIN * (place - state.p_WB), _HOLDING_SPEED)
        if landing:
            back[2] = -self._config.descent
        limited, _ = self._limited(context, back, state, landing)
        return np.append(limited, math.nan), mode, reason

    def _limited(
        self, context: Context, wanted: np.ndarray, state: QuadrotorState, landing: bool
    ) -> tuple[np.ndarray, int]:
        """The velocity (3,) within limits, and the reason for what was changed."""
        limits = self._config.limits
        slow = limit_speed(wanted, limits.max_speed)
        away, room = self._room(context, landing)
        clear = limit_approach(slow, away, room, limits.deceleration)
        lower, upper = self._lower + VEHICLE_RADIUS, self._upper - VEHICLE_RADIUS
        if landing:
            lower[2] = -math.inf
        inside = limit_to_box(clear, state.p_WB, lower, upper, limits.deceleration)
        flown = inside
        # Last, because what leads along a fence or an obstacle may lead into another.
        if self._field is not None and not landing:
            flown = limit_ahead(inside, state.p_WB, self._field, limits)
        for before, after, reason in (
            (inside, flown, status.LIMITED_CLEARANCE),
            (clear, inside, status.LIMITED_GEOFENCE),
            (slow, clear, status.LIMITED_CLEARANCE),
            (wanted, slow, status.LIMITED_SPEED),
        ):
            if not np.array_equal(before, after):
                return flown, reason
        return flown, status.NONE

    def _room(self, context: Context, landing: bool) -> tuple[np.ndarray, float]:
        """The direction (3,) away from the nearest obstacle, and the room towards it [m]."""
        clearance, gradient = (self._read(context, name) for name in ("clearance", "gradient"))
        if clearance is None or gradient is None or math.isnan(clearance[0]) or not gradient.any():
            return np.zeros(3), math.inf
        away = gradient / np.linalg.norm(gradient)
        if landing and away[2] > LEVEL:
            return away, math.inf
        return away, float(clearance[0]) - self._config.limits.min_clearance

    def _calc_flown(self, context: Context, value: Any) -> None:
        value.set_value(self._flown(context))

    def _cached(self, context: Context) -> tuple[np.ndarray, int, int]:
        return cast(Any, self.get_cache_entry(self._cache).Eval(context))

    def _calc_velocity_setpoint(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._cached(context)[0])

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        setpoint, mode, reason = self._cached(context)
        if mode == status.FLYING and reason == status.NONE:
            output.SetFromVector(np.asarray(self._read(context, "command")))
            return
        state = np.asarray(self._read(context, "state"))
        if not np.isfinite(state).all():
            output.SetFromVector(np.array([self._vehicle.gravity, 0.0, 0.0, 0.0]))
            return
        a_WB = tracking_acceleration(QuadrotorState.of(state).v_WB, setpoint[:3])
        motion = setpoint[:3] if mode == status.FLYING else np.zeros(3)
        law, vehicle = self._controller, self._vehicle
        output.SetFromVector(flatness_command(state, a_WB, motion, setpoint[3], law, vehicle))

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        waiting = _memory(context).mode == status.WAITING
        if waiting:
            output.SetFromVector(np.array([status.WAITING, status.NONE], dtype=float))
        else:
            output.SetFromVector(np.array(self._cached(context)[1:], dtype=float))

    def _calc_in_charge(self, context: Context, output: BasicVector) -> None:
        output[0] = float(_memory(context).mode != status.WAITING)

    def _calc_state_is_known(self, context: Context, output: BasicVector) -> None:
        is_recent = self._ages(context)[status.STATE_OLD] <= _PREDICTABLE
        in_charge = _memory(context).mode != status.WAITING
        output[0] = float(in_charge and is_recent and self._known(context))


def _memory(context: Context) -> Memory:
    return Memory(*np.asarray(context.get_discrete_state_vector().value()))
