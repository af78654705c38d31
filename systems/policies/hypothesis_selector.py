"""HypothesisSelector: from a fan of trajectories to the one waypoint a controller tracks."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from splatpilot.systems.policies.hypotheses import (
    NUM_WAYPOINTS,
    WAYPOINT_PERIOD,
    Hypotheses,
    hypotheses_size,
)
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


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
