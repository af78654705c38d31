"""The way to a goal where nothing stands in it, in closed form.

What the planner's lattice flies there: one quintic to where the nominal speed leads in its horizon,
or to rest in the goal, from the present velocity and the acceleration of level flight.
"""

from typing import Any

import numpy as np

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.systems.policies.motion_primitives import quintic_basis
from splatpilot.systems.vehicle.quadrotor_dynamics import GRAVITY, QuadrotorParams

HORIZON = 2.0  # [s], that of `LatticeConfig`
_LEAST_SPEED_FRACTION = 0.25  # of the nominal speed, near the goal
_STEEPEST = 0.5  # cosine of the tilt beyond which the acceleration is taken to grow no further

BASIS = quintic_basis(WAYPOINT_PERIOD * np.arange(1, NUM_WAYPOINTS + 1), HORIZON)
"""(10, 6), see `quintic_basis`; of the waypoints."""


def unobstructed_way(v_B: Any, goal_B: Any, up_B: Any, speed: float, basis: Any = BASIS) -> Any:
    """Waypoints (..., 10, 3) [m] in the body frame B, by arithmetic that arrays of numpy and
    tensors of torch have in common.

    Args:
        v_B: (..., 3) [m/s], velocity.
        goal_B: (..., 3) [m], the vector to the goal; all are alike beyond `HORIZON` x `speed`.
        up_B: (..., 3), the unit vector upwards.
        speed: [m/s], nominal.
        basis: `BASIS`, as an array of the same kind.
    """
    distance = _length(goal_B)
    direction = goal_B / distance.clip(min=1e-6)
    slowed = speed * (2.0 * distance / (HORIZON * speed)).clip(_LEAST_SPEED_FRACTION, 1.0)
    reach = HORIZON * slowed
    arrives = distance <= reach
    p_end = direction * (distance * arrives + reach * ~arrives)
    v_end = direction * (slowed * ~arrives)
    # The thrust along z_B carries the weight: what of it is level accelerates, against the drag.
    upright = up_B[..., 2:].clip(min=_STEEPEST)
    tilt = -up_B * up_B[..., 2:]
    tilt[..., 2] += 1.0
    level = v_B - up_B * (v_B * up_B).sum(-1)[..., None]
    acceleration = GRAVITY * tilt / upright - QuadrotorParams.drag * level
    return (
        _column(basis, 1) * v_B[..., None, :]
        + _column(basis, 2) * acceleration[..., None, :]
        + _column(basis, 3) * p_end[..., None, :]
        + _column(basis, 4) * v_end[..., None, :]
    )


def _length(vectors: Any) -> Any:
    return ((vectors * vectors).sum(-1) ** 0.5)[..., None]


def _column(basis: Any, number: int) -> Any:
    return basis[:, number : number + 1]
