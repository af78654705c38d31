"""Two views of one image, the second in a mirror, and what the hypotheses of both agree upon."""

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.student_inference import StudentNetwork, plan

ALIKE = 0.3
"""[m] Root mean square distance over which two trajectories cease to say the same."""
SHARPNESS = 2.0
"""[-] By how much the logarithm of a hypothesis's say falls for each unit of its cost."""


def consensus(waypoints: np.ndarray, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What hypotheses say together, about each of them.

    One step of mean shift, from every hypothesis: with weights
    w_mn = exp(-SHARPNESS c_n - |T_m - T_n|^2 / (T ALIKE^2)) the mean sum_n w_mn T_n / sum_n w_mn,
    and the cost -log sum_n w_mn: the cheapest is where most agree, and errors that they do not
    share average out.

    Args:
        waypoints: (M, T, 3) [m].
        costs: (M,).

    Returns:
        waypoints (M, T, 3) [m] and costs (M,).
    """
    apart = np.square(waypoints[:, None] - waypoints[None]).sum(3).mean(2)  # (M, M)
    weights = np.exp(-SHARPNESS * costs - apart / ALIKE**2)
    sums = weights.sum(1)
    return np.einsum("mn,ntk->mtk", weights / sums[:, None], waypoints), -np.log(sums)


def plan_both_views(
    network: StudentNetwork,
    time: float,
    image: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
) -> Hypotheses:
    """The consensus of the six hypotheses of an image, three of them seen in a mirror.

    Args, raises: see :func:`~splatpilot.systems.policies.student_inference.plan`.
    """
    views = [
        plan(network, time, image, X_WB, v_WB, p_WG, mirrored=mirrored)
        for mirrored in (False, True)
    ]
    waypoints_B, costs = consensus(
        np.concatenate([view.waypoints_B for view in views]),
        np.concatenate([view.costs for view in views]),
    )
    return Hypotheses(time, X_WB, waypoints_B, costs)
