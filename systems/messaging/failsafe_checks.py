"""What speaks against flying as a policy decides."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

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
