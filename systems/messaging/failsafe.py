"""Failsafe: what is flown if policy, state or observation cannot be trusted."""

import math
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
from splatpilot.systems.messaging.failsafe_checks import (
    Box,
    Signals,
    state_is_wrong,
    what_is_wrong,
)
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.failsafe_modes import Memory, Track
from splatpilot.systems.messaging.failsafe_velocity import Motion, Surroundings, flown_setpoint
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.policies.velocity_tracking import tracking_acceleration
from splatpilot.systems.ports import input_port, optional_input, output_port
from splatpilot.systems.vehicle.flatness_controller import (
    FlatnessControllerConfig,
    flatness_command,
)
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_prediction import LONGEST_PREDICTION
from splatpilot.systems.weakly import weakly

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
