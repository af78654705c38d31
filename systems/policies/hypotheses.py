"""Trajectory hypotheses: the output of trajectory policies, and the selection of the cheapest.

A plan is K trajectories of T = 10 waypoints at 0.1 s, in the body frame at the time of planning,
and one cost each. A Drake port holds it as the vector

    [plan_time, p_WB (3), q_WB (4, wxyz), waypoints_B (K * T * 3, row-major), costs (K)],

all NaN before the first plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)

from splatpilot.systems.common.drake import float_values, is_autodiff, system_template, vector_input
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.state import QuadrotorState, clip, make_pose

NUM_WAYPOINTS = 10
WAYPOINT_PERIOD = 0.1  # [s]

HEADER_SIZE = 8  # plan_time, p_WB, q_WB


def hypotheses_size(num_hypotheses: int) -> int:
    """Returns the length of the vector of `num_hypotheses` hypotheses."""
    require(num_hypotheses >= 1, "the number of hypotheses", "at least 1", num_hypotheses)
    return HEADER_SIZE + num_hypotheses * (NUM_WAYPOINTS * 3 + 1)


def num_hypotheses_in(size: int) -> int:
    """Returns the number of hypotheses in a vector of this length."""
    count, rest = divmod(size - HEADER_SIZE, NUM_WAYPOINTS * 3 + 1)
    sizes = f"{HEADER_SIZE} + {NUM_WAYPOINTS * 3 + 1} K for K >= 1 hypotheses"
    require(count >= 1 and not rest, "the size of a hypotheses port", sizes, size)
    return count


def no_plan(num_hypotheses: int) -> np.ndarray:
    """Returns the vector before the first plan, all NaN."""
    return np.full(hypotheses_size(num_hypotheses), np.nan)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """K trajectories in the body frame at the time of planning; waypoint `t` is for the time
    `plan_time + (t + 1) * 0.1` s. Numbers are floats, or AutoDiffXd in arrays of objects."""

    plan_time: Any  # [s]
    X_WB: RigidTransform  # at plan_time
    waypoints_B: np.ndarray  # (K, T = 10, 3) [m]
    costs: np.ndarray  # (K,), in a unit of the policy's choice

    def __post_init__(self) -> None:
        shape, count = np.shape(self.waypoints_B), np.shape(self.costs)
        valid = len(shape) == 3 and shape[0] >= 1 and shape[1:] == (NUM_WAYPOINTS, 3)
        condition = f"(K, {NUM_WAYPOINTS}, 3) with K >= 1"
        require(valid, "the shape of the waypoints", condition, shape)
        require(count == shape[:1], "the shape of the costs", str(shape[:1]), count)

    @property
    def best(self) -> int:
        """Index of the lowest cost, the first of equals."""
        return int(np.argmin(float_values(self.costs)))

    @property
    def waypoints_W(self) -> np.ndarray:
        """(K, T, 3) [m] waypoints in the world frame."""
        R_WB = self.X_WB.rotation().matrix()
        return self.waypoints_B @ R_WB.T + self.X_WB.translation()

    def position_W(self, time: Any, hypothesis: int) -> np.ndarray:
        """Interpolates p_WR (3,) [m] of a hypothesis at `time` [s] linearly, from p_WB at
        `plan_time` to the last waypoint; constant before and after."""
        along = clip((time - self.plan_time) / WAYPOINT_PERIOD, 0.0, NUM_WAYPOINTS)
        i = min(int(float_values(along)), NUM_WAYPOINTS - 1)
        knots_B = np.vstack([np.zeros(3), self.waypoints_B[hypothesis]])  # (T + 1, 3)
        p_BR = knots_B[i] + (along - i) * (knots_B[i + 1] - knots_B[i])
        return self.X_WB @ p_BR

    def to_vector(self) -> np.ndarray:
        """Returns the vector (8 + 31 K,) described at the top of this file."""
        q_WB = self.X_WB.rotation().ToQuaternion().wxyz()
        header = [self.plan_time, *self.X_WB.translation(), *q_WB]
        return np.concatenate([header, np.ravel(self.waypoints_B), self.costs])

    @classmethod
    def from_vector(cls, vector: np.ndarray, num_hypotheses: int) -> Hypotheses | None:
        """Returns the hypotheses in `vector`; None before the first plan."""
        vector = np.asarray(vector, dtype=None if is_autodiff(vector) else float)
        shape = (hypotheses_size(num_hypotheses),)
        what = f"the shape of {num_hypotheses} hypotheses"
        require(vector.shape == shape, what, str(shape), vector.shape)
        if np.isnan(float_values(vector[0])):
            return None
        return cls(
            plan_time=vector[0],
            X_WB=make_pose(vector[1:4], vector[4:8]),
            waypoints_B=vector[HEADER_SIZE:-num_hypotheses].reshape(-1, NUM_WAYPOINTS, 3),
            costs=vector[-num_hypotheses:],
        )


@system_template("HypothesisSelector_")
def HypothesisSelector_(T):
    class HypothesisSelector(LeafSystem_[T]):
        """Follows the hypothesis of lowest cost, `lookahead` ahead of the present time.

        .. pydrake_system::

            name: HypothesisSelector
            input_ports: [hypotheses, state]
            output_ports: [waypoint]

        - ``hypotheses`` (8 + 31 K): as `Hypotheses.to_vector`.
        - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
        - ``waypoint`` (3): p_WR [m], W frame, by `Hypotheses.position_W`; p_WB before the first
          plan; NaN if the lowest cost is infinite or a cost is NaN.

        Supports the scalars float and AutoDiffXd; the choice itself has no derivatives.

        Args:
            num_hypotheses: K, as at the policy.
            lookahead: [s], in (0, 1], as at the controller.
        """

        def __init__(
            self, num_hypotheses: int = 3, lookahead: float = 0.4, *, converter: Any = None
        ) -> None:
            super().__init__(converter=converter)
            span = NUM_WAYPOINTS * WAYPOINT_PERIOD
            require(0.0 < lookahead <= span, "lookahead", f"in (0, {span:g}] s", lookahead)
            self._num_hypotheses, self._lookahead = num_hypotheses, lookahead
            self.DeclareVectorInputPort("hypotheses", hypotheses_size(num_hypotheses))
            self.DeclareVectorInputPort("state", 13)
            self.DeclareVectorOutputPort("waypoint", 3, self._calc_waypoint)

        def _calc_waypoint(self, context, output):
            vector = vector_input(self, "hypotheses", context)
            plan = Hypotheses.from_vector(vector, self._num_hypotheses)
            if plan is None:
                state = vector_input(self, "state", context)
                output.SetFromVector(QuadrotorState.of(state).p_WB)
            elif not np.isfinite(float_values(plan.costs).min()):
                output.SetFromVector(np.full(3, np.nan))
            else:
                time = context.get_time() + self._lookahead
                output.SetFromVector(plan.position_W(time, plan.best))

    return HypothesisSelector


HypothesisSelector = HypothesisSelector_[None]
