"""When a vehicle is taken from its policy, and what speaks against flying by it."""

import math
from dataclasses import dataclass, field

import numpy as np

from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.flight_limits import FlightLimits
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

_SLACK = 1.01  # [-], by which a command may exceed what its controller is limited to.


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


def wrong_with_command(
    setpoint: np.ndarray | None, command: np.ndarray, law: FlatnessControllerConfig
) -> int:
    """
    The reason not to send on what a policy and its controller want, or NONE.

    Args:
        setpoint: (4,) velocity [m/s] and heading [rad], which may be NaN; None where there is none.
        command: (4,) thrust over mass [m/s^2] and body rates [rad/s].
        law: whose limits the command must keep.
    """
    if not np.isfinite(command).all():
        return status.NOT_FINITE
    if setpoint is not None and not (
        np.isfinite(setpoint[:3]).all() and abs(setpoint[3]) != math.inf
    ):
        return status.NOT_FINITE
    most = np.array([law.max_tilt_rate, law.max_tilt_rate, law.max_yaw_rate])
    thrust_is_so = 0.0 <= command[0] <= _SLACK * law.max_thrust
    if not thrust_is_so or (np.abs(command[1:]) > _SLACK * most).any():
        return status.OUT_OF_BOUNDS
    return status.NONE


def wrong_with_state(
    state: QuadrotorState, max_tilt: float, lower: np.ndarray, upper: np.ndarray
) -> int:
    """The reason not to fly on from a state, or NONE: a tilt beyond `max_tilt` [rad], or a place
    outside of the box from `lower` to `upper` (3,) [m]."""
    w, x, y, z = state.q_WB
    if w * w - x * x - y * y + z * z < math.cos(max_tilt):
        return status.TILTED
    if ((state.p_WB < lower) | (state.p_WB > upper)).any():
        return status.OUTSIDE
    return status.NONE
