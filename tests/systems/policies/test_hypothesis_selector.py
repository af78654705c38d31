import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.policies.hypotheses import Hypotheses, HypothesisSelector, no_plan
from splatpilot.systems.vehicle.quadrotor import hover_state


def waypoint(selector, vector, time):
    context = selector.CreateDefaultContext()
    context.SetTime(time)
    selector.GetInputPort("hypotheses").FixValue(context, vector)
    selector.GetInputPort("state").FixValue(context, hover_state([7.0, 8.0, 9.0]))
    return np.asarray(selector.GetOutputPort("waypoint").Eval(context))


def test_hovers_before_the_first_plan():
    """Without a plan the waypoint is the vehicle's own position."""
    np.testing.assert_array_equal(waypoint(HypothesisSelector(3), no_plan(3), 0.5), [7, 8, 9])


def test_follows_the_cheapest_a_lookahead_ahead():
    """The waypoint is that of the cheapest hypothesis at now + lookahead, in the world."""
    X_WB = RigidTransform(RollPitchYaw(0.1, 0.2, 1.5), np.array([1.0, 2.0, 3.0]))
    velocities_B = np.array([[1.0, 0, 0], [0, 2.0, 0.5], [0, 0, 3.0]])
    times = 0.1 * np.arange(1, 11)
    plan = Hypotheses(
        4.0, X_WB, velocities_B[:, None] * times[:, None], costs=np.array([5.0, 1.0, 9.0])
    )
    got = waypoint(HypothesisSelector(3, lookahead=0.4), plan.to_vector(), 4.03)
    np.testing.assert_allclose(got, X_WB @ (0.43 * velocities_B[1]), atol=1e-12)


@pytest.mark.parametrize("costs", [[1.0, np.nan], [np.nan, 1.0], [np.inf, np.inf], [0.0, -np.inf]])
def test_without_a_cheapest_hypothesis_there_is_no_waypoint(costs):
    plan = Hypotheses(0.0, RigidTransform(), np.ones((2, 10, 3)), np.array(costs))
    got = waypoint(HypothesisSelector(2), plan.to_vector(), 0.1)
    np.testing.assert_array_equal(got, np.full(3, np.nan))


@pytest.mark.parametrize("lookahead", [0.0, -0.1, 1.01, np.nan])
def test_a_lookahead_beyond_the_plan_is_refused(lookahead):
    """The lookahead must lie within the second that a plan spans."""
    with pytest.raises(ValueError, match=r"lookahead must be in \(0, 1\] s, got "):
        HypothesisSelector(3, lookahead)
