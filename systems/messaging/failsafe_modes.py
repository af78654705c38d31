"""In which mode a failsafe is, and what it remembers for that."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flight_limits import limit_speed

_STOPPED = 0.3  # [m/s], below which a place is held instead of braking.
_HOLDING_GAIN = 1.0  # [1/s], with which the place is returned to, and
_HOLDING_SPEED = 1.0  # [m/s], the greatest speed at which.


class Memory(NamedTuple):
    """The discrete state of a `Failsafe`: numbers, as Drake has it."""

    mode: float = status.WAITING
    reason: float = status.NONE
    since: float = 0.0  # [s], when the mode began.
    well: float = math.nan  # [s], since when all has been well.
    x: float = math.nan  # [m], the place that is held, NaN while there is none.
    y: float = math.nan
    z: float = math.nan
    seen_x: float = math.nan  # [m], the position that was measured last,
    seen_y: float = math.nan
    seen_z: float = math.nan
    moved: float = 0.0  # [s], and when it was another.

    def seeing(self, p_WB: np.ndarray, now: float) -> "Memory":
        """After a position (3,) [m] was measured."""
        x, y, z = p_WB
        if (x, y, z) == (self.seen_x, self.seen_y, self.seen_z):
            return self
        return self._replace(seen_x=x, seen_y=y, seen_z=z, moved=now)

    def after(self, wrong: int, waits: bool, now: float, config: FailsafeConfig) -> "Memory":
        """
        After another period.

        Args:
            wrong: what is, a reason of `lcmt_bridge_status`.
            waits: whether something has never come.
            now: [s].
        """
        well = math.nan if wrong or waits else (now if math.isnan(self.well) else self.well)
        memory = self._replace(well=well)
        if self.mode == status.WAITING and not waits:
            return memory._begun(status.FLYING, status.NONE, now)
        if self.mode == status.FLYING and wrong:
            return memory._begun(status.HOLDING, wrong, now)
        if self.mode == status.HOLDING and now - well >= config.recovery:
            return memory._begun(status.FLYING, status.NONE, now)
        if self.mode == status.HOLDING and now - self.since > config.patience:
            return memory._replace(mode=status.LANDING, since=now)
        return memory

    def holding(self, p_WB: np.ndarray, v_WB: np.ndarray) -> "Memory":
        """With the place (3,) [m] that is held, once the vehicle has come to rest there."""
        is_flying, has_place = self.mode == status.FLYING, not math.isnan(self.x)
        if is_flying or has_place or not np.linalg.norm(v_WB) < _STOPPED:
            return self
        x, y, z = p_WB
        return self._replace(x=x, y=y, z=z)

    def return_velocity(self, p_WB: np.ndarray) -> np.ndarray:
        """The velocity (3,) [m/s] from p_WB (3,) [m] to the place that is held; 0 without one."""
        if math.isnan(self.x):
            return np.zeros(3)
        place = np.array([self.x, self.y, self.z])
        return limit_speed(_HOLDING_GAIN * (place - p_WB), _HOLDING_SPEED)

    def _begun(self, mode: int, reason: int, now: float) -> "Memory":
        return self._replace(
            mode=mode, reason=reason, since=now, x=math.nan, y=math.nan, z=math.nan
        )
