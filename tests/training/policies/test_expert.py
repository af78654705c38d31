"""The expert's flights by a policy, and its labels."""

import numpy as np
import pytest

from splatpilot.diagrams.flight.flight import Outcome
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.feasibility import draw_start_and_goal
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.training.corpus.expert import ExpertConfig, Labeler, fly_policy

WORLD = ForestConfig(length=12.0, width=8.0, height=4.0)
REACTIVE = ExpertConfig(policy="reactive")


@pytest.fixture(scope="module")
def world():
    return make_world(WORLD, 1_000_000)


def test_a_policy_flies_and_the_planner_labels(world):
    """Between ends drawn from the distance field a policy that sees arrives with room to spare, and
    the best label of every 0.4 s keeps clear."""
    p_WS, p_WG, _ = draw_start_and_goal(world.esdf, VEHICLE_RADIUS, seed=2)
    scenario = Scenario(world=WORLD, start=p_WS.tolist(), goal=p_WG.tolist(), start_radius=0.0)
    labeler = Labeler(world.esdf, p_WG, REACTIVE)
    flight = fly_policy(scenario, world, REACTIVE, labeler)
    assert flight.outcome is Outcome.GOAL
    assert flight.is_demonstration
    assert flight.least_clearance > 0.0
    assert len(flight.labels) == np.ceil(flight.time / 0.4)
    np.testing.assert_allclose(flight.labels[0].state[:3], p_WS)
    for label in flight.labels:
        assert label.plan.waypoints_B.shape == (3, 10, 3)
        assert (world.distance_field.distance(label.plan.waypoints_W[0]) > VEHICLE_RADIUS).all()


def test_flights_that_fail_are_no_demonstrations(world):
    """A flight that does not arrive in time is none; a policy nobody knows is an error."""
    labeler = Labeler(world.esdf, world.p_WG, REACTIVE)
    flight = fly_policy(Scenario(world=WORLD, timeout=1.0), world, REACTIVE, labeler)
    assert (flight.outcome, flight.is_demonstration) == (Outcome.TIMEOUT, False)
    with pytest.raises(ValueError, match="no policy 'nobody'"):
        ExpertConfig(policy="nobody").validate()


def test_states_without_a_way_on_are_not_labeled():
    wall = np.zeros((60, 20, 20), bool)
    wall[30] = True
    esdf = esdf_from_occupancy(wall, np.zeros_like(wall), np.zeros(3), 0.2)
    labeler = Labeler(esdf, np.array([10.0, 2.0, 2.0]), REACTIVE)
    beside, behind = hover_state([8.0, 2.0, 2.0]), hover_state([3.0, 2.0, 2.0])
    labels = labeler.labels([behind, beside])
    assert len(labels) == 1
    np.testing.assert_array_equal(labels[0].state, beside)
