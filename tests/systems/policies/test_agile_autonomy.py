import numpy as np

from splatpilot.systems.policies import agile_autonomy
from splatpilot.systems.policies.base import observation
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import pose_from_state

X = hover_state([0, 0, 2])
PATH = np.linspace(0.1, 1.0, 10)[:, None]


def test_near_ties_continue_the_last_plan():
    left, right, up = PATH * [1.0, 1.0, 0.0], PATH * [1.0, -1.0, 0.0], PATH * [0.0, 0.0, 1.0]
    X_WB = pose_from_state(X)
    last = Hypotheses(0.0, X_WB, np.stack([right, left, up]), np.array([0.1, 0.5, 0.9]))
    for costs, expected in (
        ([0.100, 0.101, 0.9], [1]),
        ([0.100, 0.900, 0.9], [0]),
        ([0.100, 0.900, 0.101], [0, 2]),
    ):
        new = Hypotheses(0.1, X_WB, np.stack([left, right, up]), np.array(costs))
        assert agile_autonomy.prefer_continuation(new, last).best in expected


def test_progress_reduces_costs():
    def network(image, state):
        ahead = PATH * [1, 0, 0]
        return np.stack([0.2 * ahead, ahead, -ahead]), np.full(3, 0.3)

    seen = observation(0.0, X, np.array([9, 0, 2]), np.full((24, 32), 9.0))
    plan = agile_autonomy.plan(network, seen, 2.0, None)
    np.testing.assert_allclose(plan.costs, [0.28, 0.2, 0.4])
