import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.policies.hypotheses import (
    Hypotheses,
    HypothesisSelector,
    hypotheses_size,
    no_plan,
    num_hypotheses_in,
)
from splatpilot.systems.vehicle.quadrotor import hover_state
from tests.systems.vehicle.responses import evaluate


def some_hypotheses(count=3):
    rng = np.random.default_rng(4)
    X_WB = RigidTransform(RollPitchYaw(0.2, -0.3, 2.0), np.array([1.0, -2.0, 3.0]))
    return Hypotheses(2.0, X_WB, rng.normal(size=(count, 10, 3)), rng.uniform(size=count))


@pytest.mark.parametrize("count", [1, 3])
def test_plans_are_kept_in_a_vector(count):
    plan = some_hypotheses(count)
    vector = plan.to_vector()
    assert vector.shape == (hypotheses_size(count),)
    again = Hypotheses.from_vector(vector, count)
    assert again is not None and again.plan_time == plan.plan_time
    np.testing.assert_array_equal(again.waypoints_B, plan.waypoints_B)
    np.testing.assert_array_equal(again.costs, plan.costs)
    assert again.X_WB.IsNearlyEqualTo(plan.X_WB, 1e-15)
    np.testing.assert_allclose(vector[:4], [2.0, 1.0, -2.0, 3.0])
    np.testing.assert_allclose(vector[4:8], plan.X_WB.rotation().ToQuaternion().wxyz())
    np.testing.assert_array_equal(vector[8:38].reshape(10, 3), plan.waypoints_B[0])
    np.testing.assert_array_equal(vector[-count:], plan.costs)
    assert Hypotheses.from_vector(no_plan(count), count) is None


def test_position_interpolates_between_waypoints():
    plan = some_hypotheses()
    path_W = np.vstack([plan.X_WB.translation(), plan.waypoints_W[1]])
    np.testing.assert_allclose(path_W[8], plan.X_WB @ plan.waypoints_B[1, 7], atol=1e-14)
    for time, expected in [
        (2.0, path_W[0]),
        (2.1, path_W[1]),
        (2.35, 0.5 * (path_W[3] + path_W[4])),
        (3.0, path_W[10]),
        (9.0, path_W[10]),
        (1.0, path_W[0]),
    ]:
        np.testing.assert_allclose(plan.position_W(time, 1), expected, atol=1e-12)


def test_invalid_shapes_are_refused():
    with pytest.raises(ValueError, match=r"2 hypotheses must be \(70,\), got \(101,\)"):
        Hypotheses.from_vector(no_plan(3), 2)
    with pytest.raises(ValueError, match=r"\(K, 10, 3\).* got \(3, 9, 3\)"):
        Hypotheses(0.0, RigidTransform(), np.zeros((3, 9, 3)), np.zeros(3))
    with pytest.raises(ValueError, match=r"\(3,\), got \(2,\)"):
        Hypotheses(0.0, RigidTransform(), np.zeros((3, 10, 3)), np.zeros(2))
    with pytest.raises(ValueError, match="at least 1, got 0"):
        hypotheses_size(0)
    assert [num_hypotheses_in(hypotheses_size(k)) for k in (1, 3, 7)] == [1, 3, 7]
    for size in (8, 13, 40):
        with pytest.raises(ValueError, match=f"hypotheses, got {size}"):
            num_hypotheses_in(size)


def waypoint(selector, vector, time):
    return evaluate(selector, time=time, hypotheses=vector, state=hover_state([7.0, 8.0, 9.0]))


def test_selector_follows_the_cheapest_a_lookahead_ahead():
    X_WB = RigidTransform(RollPitchYaw(0.1, 0.2, 1.5), np.array([1.0, 2.0, 3.0]))
    velocities_B = np.array([[1.0, 0, 0], [0, 2.0, 0.5], [0, 0, 3.0]])
    waypoints_B = velocities_B[:, None] * (0.1 * np.arange(1, 11))[:, None]
    plan = Hypotheses(4.0, X_WB, waypoints_B, costs=np.array([5.0, 1.0, 9.0]))
    found = waypoint(HypothesisSelector(3, lookahead=0.4), plan.to_vector(), 4.03)
    np.testing.assert_allclose(found, X_WB @ (0.43 * velocities_B[1]), atol=1e-12)
    np.testing.assert_array_equal(waypoint(HypothesisSelector(3), no_plan(3), 0.5), [7, 8, 9])


@pytest.mark.parametrize("costs", [[1.0, np.nan], [np.nan, 1.0], [np.inf, np.inf], [0.0, -np.inf]])
def test_without_a_cheapest_hypothesis_there_is_no_waypoint(costs):
    plan = Hypotheses(0.0, RigidTransform(), np.ones((2, 10, 3)), np.array(costs))
    found = waypoint(HypothesisSelector(2), plan.to_vector(), 0.1)
    np.testing.assert_array_equal(found, np.full(3, np.nan))
