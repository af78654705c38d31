"""Detection of faults in the inputs of a failsafe."""

import math
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from splatpilot.systems.messaging.flight_limits import Box
from splatpilot.systems.messaging.messages import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.state import QuadrotorState, predict_state

SEVERITY = (
    *(status.STATE_OLD, status.STATE_FROZEN, status.STATE_JUMPED, status.BODY_LOST),
    *(status.TILTED, status.OVERRUN, status.OUTSIDE, status.OBSERVATION_OLD),
    *(status.POLICY_FAILED, status.NOT_FINITE, status.OUT_OF_BOUNDS, status.NONE),
)
"""Faults, the most severe first: unknown position, danger, unknown target."""

_TOLERANCE = 1.01  # [-] by which a command may exceed the limits of its controller.


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
        newest = max(self.ages[status.STATE_OLD], self.unchanged)
        return newest <= max_age and not self.jumped

    def fault(
        self,
        max_age: float,
        max_lag: float,
        max_tilt: float,
        law: FlatnessControllerConfig,
        box: Box,
    ) -> int:
        """Returns the most severe fault, a reason of `lcmt_bridge_status`, or NONE. The limits of
        `law` hold for the command. The box must hold the vehicle, unless only commands are sent:
        their sender is responsible for the position."""
        max_rates = _TOLERANCE * np.array([law.max_tilt_rate, law.max_tilt_rate, law.max_yaw_rate])
        max_thrust = _TOLERANCE * law.max_thrust
        thrust, rates, p_WB = self.command[0], self.command[1:], self.state.p_WB
        faults = {reason: not age <= max_age for reason, age in self.ages.items()} | {
            status.STATE_FROZEN: self.unchanged > max_age,
            status.STATE_JUMPED: self.jumped,
            status.OVERRUN: self.lag > max_lag,
            status.POLICY_FAILED: self.policy_failed,
            status.NOT_FINITE: not np.isfinite(self.command).all(),
            status.OUT_OF_BOUNDS: not 0.0 <= thrust <= max_thrust or (abs(rates) > max_rates).any(),
            status.TILTED: self.state.tilt > max_tilt,
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
_FORGETTING = 0.5  # [s] time constant with which such differences fade.


class Track(NamedTuple):
    """The sequence of measured states, in the discrete state of a `Failsafe`."""

    time: float = -math.inf  # [s] of the measurement of the last state with new content,
    changed: float = 0.0  # [s] and of its arrival.
    jumped: float = 0.0  # 1 if it does not follow from those before.
    state: np.ndarray = np.full(13, math.nan)
    expected: np.ndarray = np.full(13, math.nan)  # state predicted by velocities and body rates.

    @classmethod
    def read(cls, context: Context) -> "Track":
        """Inverts `np.hstack`."""
        vector = np.asarray(context.get_discrete_state(1).value())
        return cls(*vector[:3], state=vector[3:16], expected=vector[16:])

    def after(self, state: np.ndarray, time: float, now: float, max_gap: float) -> "Track":
        """Adds a state (13,) that was measured at `time` [s].

        It has jumped if it is not where the velocities of the states have led, or not rotated as
        their angular velocities say. Small differences fade. A jump remains one until the state
        comes back, since the map does not fit to the position any more. Measurements more than
        `max_gap` [s] apart start again.
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
