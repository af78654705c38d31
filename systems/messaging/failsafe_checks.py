"""What speaks against flying as a policy decides."""

import math
from typing import NamedTuple

import numpy as np

from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

_MOVING = 0.3  # [m/s], from which on a position that stands still is none.
_SLACK = 1.01  # [-], by which a command may exceed what its controller is limited to.


class Box(NamedTuple):
    """Where a vehicle may fly."""

    lower_W: np.ndarray  # (3,) [m]
    upper_W: np.ndarray  # (3,) [m]


class Signals(NamedTuple):
    """What is flown by, at one instant."""

    ages: dict[int, float]
    """[s], by the reasons of `lcmt_bridge_status` for not flying by what is too old."""
    still: float
    """[s], since the position that is measured changed."""
    lag: float
    """[s], by which the process is behind the wall clock."""
    state: QuadrotorState
    setpoint: np.ndarray | None
    """(4,) velocity [m/s], W frame, and heading [rad], which may be NaN; None where commands alone
    are sent."""
    command: np.ndarray
    """(4,) thrust over mass [m/s^2] and body rates [rad/s]."""


def what_is_wrong(
    signals: Signals, config: FailsafeConfig, law: FlatnessControllerConfig, box: Box
) -> int:
    """
    The first reason of `lcmt_bridge_status` not to fly as a policy decides, or NONE.

    Args:
        law: whose limits the command must keep.
        box: in which the vehicle must be, unless it is told commands alone: who sends these is in
            charge of no place.
    """
    for reason, age in signals.ages.items():
        if not age <= config.max_age:
            return reason
    if signals.still > config.max_age and np.linalg.norm(signals.state.v_WB) > _MOVING:
        return status.STATE_FROZEN
    if signals.lag > config.max_lag:
        return status.OVERRUN
    wrong = _wrong_with_command(signals.setpoint, signals.command, law)
    fence = None if signals.setpoint is None else box
    return wrong or _wrong_with_state(signals.state, config.limits.max_tilt, fence)


def _wrong_with_command(
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


def _wrong_with_state(state: QuadrotorState, max_tilt: float, box: Box | None) -> int:
    """The reason not to fly on from a state, or NONE: a tilt beyond `max_tilt` [rad], or a place
    outside of the box."""
    if state.tilt > max_tilt:
        return status.TILTED
    if box is not None and ((state.p_WB < box.lower_W) | (state.p_WB > box.upper_W)).any():
        return status.OUTSIDE
    return status.NONE
