"""In which mode a failsafe is, and what it remembers for that."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.messaging.failsafe_checks import most_severe
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flight_limits import RETURN_SPEED, limit_speed
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_prediction import predict_state

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
