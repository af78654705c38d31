"""The expert's rollouts."""

import numpy as np
import pytest

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.start_and_goal import draw_start_and_goal
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.training.policies.expert import ExpertConfig, expert_rollout

WORLD = ForestConfig(length=12.0, width=8.0, height=4.0)


@pytest.fixture(scope="module")
def world():
    return make_world(WORLD, 1_000_000)


def test_rollout_reaches_a_drawn_goal_and_labels_lead_on(world):
    """Between ends drawn from the distance field the expert arrives with room to spare, and the
    best label of every state keeps clear."""
    p_WS, p_WG, _ = draw_start_and_goal(world.esdf, VEHICLE_RADIUS, seed=2)
    scenario = Scenario(world=WORLD, start=p_WS.tolist(), goal=p_WG.tolist(), start_radius=0.0)
    rollout = expert_rollout(scenario, world, ExpertConfig(period=0.4))
    assert rollout is not None
    assert np.nanmin(rollout.flight.clearances) > 0.0
    assert np.linalg.norm(rollout.flight.states[-1, :3] - p_WG) <= scenario.goal_radius
    count = len(rollout.states)
    assert count == np.ceil(rollout.flight.times[-1] / 0.4)
    assert rollout.waypoints_B.shape == (count, 3, 10, 3)
    assert (np.diff(rollout.costs, axis=1) >= 0.0).all()
    for state, waypoints, costs in zip(
        rollout.states, rollout.waypoints_B, rollout.costs, strict=True
    ):
        label = Hypotheses(0.0, pose_from_state(state), waypoints, costs).waypoints_W[0]
        assert (world.distance_field.distance(label) > VEHICLE_RADIUS).all()


def test_flights_that_fail_are_no_rollouts(world):
    """A flight that does not arrive in time is None; a policy nobody knows is an error."""
    assert expert_rollout(Scenario(world=WORLD, timeout=1.0), world, ExpertConfig()) is None
    with pytest.raises(ValueError, match="no policy 'nobody'"):
        expert_rollout(Scenario(world=WORLD), world, ExpertConfig(policy="nobody"))
