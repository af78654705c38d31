"""Trajectory hypotheses, what every trajectory policy returns, and their form as a vector.

A policy answers an observation with K candidate trajectories of T = 10 waypoints at 0.1 s, in the
body frame at the moment of planning, and one cost each. On a Drake port they travel as the vector

    [plan_time, p_WB (3), q_WB (4, wxyz), waypoints_B (K * T * 3, row-major), costs (K)],

all NaN before the first plan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.vehicle.state import QuadrotorState

NUM_WAYPOINTS = 10
WAYPOINT_PERIOD = 0.1  # [s]

_HEADER = 8  # plan_time, p_WB, q_WB


def hypotheses_size(num_hypotheses: int) -> int:
    """The length of the vector that holds `num_hypotheses` hypotheses.

    Raises:
        ValueError: if `num_hypotheses` is less than 1.
    """
    if num_hypotheses < 1:
        raise ValueError(
            f"The number of hypotheses is {num_hypotheses}, but a policy returns at least 1."
        )
    return _HEADER + num_hypotheses * (NUM_WAYPOINTS * 3 + 1)


def num_hypotheses_in(size: int) -> int:
    """How many hypotheses a vector of this length holds.

    Raises:
        ValueError: if no number of hypotheses takes this length.
    """
    count, rest = divmod(size - _HEADER, NUM_WAYPOINTS * 3 + 1)
    if count < 1 or rest:
        raise ValueError(
            f"A hypotheses port has size {size}, but K hypotheses take "
            f"{_HEADER} + {NUM_WAYPOINTS * 3 + 1} K; see `Hypotheses.to_vector`."
        )
    return count


def no_plan(num_hypotheses: int) -> np.ndarray:
    """The vector that stands for "no plan yet": NaN throughout."""
    return np.full(hypotheses_size(num_hypotheses), np.nan)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """K candidate trajectories in the body frame of the moment they were planned.

    Waypoint `t` (from 0) is where the vehicle should be at `plan_time + (t + 1) * 0.1` s. The
    order is the policy's own; `best` is the one of lowest cost.
    """

    plan_time: float
    """When the plan was made [s]."""
    X_WB: RigidTransform
    """Pose of the body when the plan was made."""
    waypoints_B: np.ndarray
    """(K, T = 10, 3) [m] waypoints in the body frame B of that pose."""
    costs: np.ndarray
    """(K,) cost of each trajectory, lower is better; the unit is the policy's own."""

    def __post_init__(self) -> None:
        shape, count = np.shape(self.waypoints_B), np.shape(self.costs)
        if len(shape) != 3 or shape[0] < 1 or shape[1:] != (NUM_WAYPOINTS, 3):
            raise ValueError(
                f"The waypoints have shape {shape}; give (K, {NUM_WAYPOINTS}, 3) with K >= 1."
            )
        if count != shape[:1]:
            raise ValueError(
                f"The costs have shape {count}, but there are {shape[0]} trajectories; give one "
                "cost for each."
            )

    @property
    def best(self) -> int:
        """Index of the hypothesis of lowest cost (the first of equals)."""
        return int(np.argmin(self.costs))

    @property
    def waypoints_W(self) -> np.ndarray:
        """(K, T, 3) [m] waypoints in the world frame."""
        R_WB = self.X_WB.rotation().matrix()
        return self.waypoints_B @ R_WB.T + self.X_WB.translation()

    def position_W(self, time: float, hypothesis: int) -> np.ndarray:
        """p_WR (3,) [m], where `hypothesis` wants the vehicle at `time` [s].

        Linear between waypoints, from p_WB at `plan_time`; before it p_WB, after the last waypoint
        the last waypoint.
        """
        along = np.clip((time - self.plan_time) / WAYPOINT_PERIOD, 0.0, NUM_WAYPOINTS)
        i = min(int(along), NUM_WAYPOINTS - 1)
        knots_B = np.vstack([np.zeros(3), self.waypoints_B[hypothesis]])  # (T + 1, 3)
        p_BR = knots_B[i] + (along - i) * (knots_B[i + 1] - knots_B[i])
        return self.X_WB @ p_BR

    def to_vector(self) -> np.ndarray:
        """The vector (8 + 31 K,) described at the top of this file."""
        return np.concatenate(
            [
                [self.plan_time],
                self.X_WB.translation(),
                self.X_WB.rotation().ToQuaternion().wxyz(),
                np.ravel(self.waypoints_B),
                self.costs,
            ]
        )

    @classmethod
    def from_vector(cls, vector: np.ndarray, num_hypotheses: int) -> Hypotheses | None:
        """The hypotheses that `vector` holds, or None where nothing is planned yet.

        Raises:
            ValueError: if `vector` is not as long as `hypotheses_size(num_hypotheses)`.
        """
        vector = np.asarray(vector, dtype=float)
        size = hypotheses_size(num_hypotheses)
        if vector.shape != (size,):
            raise ValueError(
                f"The hypotheses vector has shape {vector.shape}, but {num_hypotheses} hypotheses "
                f"take ({size},); give both ends of the connection the same number of hypotheses."
            )
        if np.isnan(vector[0]):
            return None
        q_WB = vector[4:8]
        return cls(
            plan_time=float(vector[0]),
            X_WB=RigidTransform(Quaternion(wxyz=q_WB / np.linalg.norm(q_WB)), vector[1:4]),
            waypoints_B=vector[_HEADER:-num_hypotheses].reshape(-1, NUM_WAYPOINTS, 3),
            costs=vector[-num_hypotheses:],
        )


class HypothesisSelector(LeafSystem):
    """Follows the hypothesis of lowest cost, a fixed time ahead of now.

    .. pydrake_system::

        name: HypothesisSelector
        input_ports:
        - hypotheses
        - state
        output_ports:
        - waypoint

    `hypotheses` is the vector of `Hypotheses.to_vector` for `num_hypotheses` trajectories and
    `state` the 13 numbers [p_WB, v_WB, q_WB, w_WB_B]. `waypoint` (3) is p_WR [m], W frame: where
    the cheapest trajectory wants the vehicle at `now + lookahead`, interpolated linearly between
    its waypoints. A plan that has run out holds its last waypoint; before the first plan the
    waypoint is the present position, so that the vehicle hovers; it is NaN if the lowest
    cost is infinite or a cost is NaN, since then no trajectory is the cheapest. Stateless, no rate
    of its own.
    """

    hypotheses_input_port = input_port("hypotheses")
    state_input_port = input_port("state")
    waypoint_output_port = output_port("waypoint")

    def __init__(self, num_hypotheses: int = 3, lookahead: float = 0.4) -> None:
        """Constructs the system.

        Args:
            num_hypotheses: K, as at the policy.
            lookahead: how far ahead of now the waypoint lies [s], as at the controller.

        Raises:
            ValueError: if `lookahead` is not within (0, 1] s, the span of a plan.
        """
        super().__init__()
        span = NUM_WAYPOINTS * WAYPOINT_PERIOD
        if not 0.0 < lookahead <= span:
            raise ValueError(
                f"The lookahead is {lookahead} s, but a plan spans {span} s: choose a lookahead "
                f"in (0, {span}]."
            )
        self._num_hypotheses = num_hypotheses
        self._lookahead = lookahead
        self._hypotheses_port = self.DeclareVectorInputPort(
            "hypotheses", hypotheses_size(num_hypotheses)
        )
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorOutputPort("waypoint", 3, self._calc_waypoint)

    def _calc_waypoint(self, context: Context, output: BasicVector) -> None:
        plan = Hypotheses.from_vector(
            np.asarray(self._hypotheses_port.Eval(context)), self._num_hypotheses
        )
        if plan is None:
            state = np.asarray(self._state_port.Eval(context))
            output.SetFromVector(QuadrotorState.of(state).p_WB)
        elif not np.isfinite(plan.costs.min()):
            output.SetFromVector(np.full(3, np.nan))
        else:
            time = context.get_time() + self._lookahead
            output.SetFromVector(plan.position_W(time, plan.best))
