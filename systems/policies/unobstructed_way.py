"""The way to a goal where nothing stands in it, in closed form.

What the planner's lattice flies there: one quintic to where the nominal speed leads in its horizon,
or to rest in the goal, from the present velocity and the acceleration of level flight.
"""

from typing import Any

import numpy as np

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.systems.policies.motion_primitives import STEEPEST, quintic_basis
from splatpilot.systems.policies.trajectory_lattice import LEAST_SPEED_FRACTION, LatticeConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams

HORIZON = LatticeConfig.horizon  # [s]

MARGIN = 1e-3
"""[-] Part of the reach by which a goal is nearer that is arrived at. Goals beyond are told as
exactly there: rounding must not decide between stopping and flying on."""

BASIS = quintic_basis(WAYPOINT_PERIOD * np.arange(1, NUM_WAYPOINTS + 1), HORIZON)
"""(10, 6), see `quintic_basis`; of the waypoints."""


def unobstructed_way(
    v_B: Any, goal_B: Any, up_B: Any, speed: float, basis: Any = BASIS, margin: float = MARGIN
) -> Any:
    """Waypoints (..., 10, 3) [m] in the body frame B, by arithmetic that arrays of numpy and
    tensors of torch have in common.

    Args:
        v_B: (..., 3) [m/s], velocity.
        goal_B: (..., 3) [m], the vector to the goal; all are alike from `HORIZON` x `speed` on.
        up_B: (..., 3), the unit vector upwards.
        speed: [m/s], nominal.
        basis: `BASIS`, as an array of the same kind.
        margin: see `MARGIN`.
    """
    distance = ((goal_B * goal_B).sum(-1) ** 0.5)[..., None]
    direction = goal_B / distance.clip(min=1e-6)
    slowed = speed * (2.0 * distance / (HORIZON * speed)).clip(LEAST_SPEED_FRACTION, 1.0)
    reach = HORIZON * slowed
    arrives = distance <= (1.0 - margin) * reach
    p_end = direction * (distance * arrives + reach * ~arrives)
    v_end = direction * (slowed * ~arrives)
    boundary = v_B, _level_acceleration(v_B, up_B), p_end, v_end
    return sum(
        basis[:, column, None] * values[..., None, :] for column, values in enumerate(boundary, 1)
    )


def _level_acceleration(v_B: Any, up_B: Any) -> Any:
    """See `motion_primitives.level_acceleration`; in the body frame."""
    upright = up_B[..., 2:]  # the cosine of the tilt
    tilt = -up_B * upright
    tilt[..., 2] += 1.0
    level = v_B - up_B * (v_B * up_B).sum(-1)[..., None]
    params = QuadrotorParams()
    return params.gravity * tilt / upright.clip(min=STEEPEST) - params.drag * level
