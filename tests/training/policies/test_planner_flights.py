"""Flights of the planner, many at once."""

import numpy as np
import pytest

from splatpilot.diagrams.flight.flight import Outcome, fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.planner import PrivilegedPlannerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.corpus import expert as planner_flights
from splatpilot.training.corpus.expert import ExpertConfig, Labeler, fly_planner

WORLD = ForestConfig(length=12.0, width=8.0, height=4.0)


@pytest.fixture(scope="module")
def world():
    return make_world(WORLD, 1_000_000)


@pytest.fixture(scope="module")
def labeler(world):
    return Labeler(world.esdf, world.p_WG, ExpertConfig())


@pytest.fixture(scope="module")
def starts(world):
    return np.stack([world.p_WS, np.add(world.p_WS, [0.5, -1.0, 0.6])])


@pytest.fixture(scope="module")
def flights(starts, world, labeler):
    return fly_planner(starts, world, ExpertConfig(), labeler)


def test_flies_as_the_diagram_does(world, starts, flights):
    """The same planner in Drake, with its plant and controller, takes the same way: every labeled
    state is within 0.15 m of the diagram's at that time, and both arrive together."""
    policy = PrivilegedPlannerConfig(rate=2.5)
    start = starts[0].tolist()
    scenario = Scenario(world=WORLD, start_radius=0.0, start=start, policy=policy)
    drake = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
    ours = flights[0]
    assert ours.outcome is drake.outcome is Outcome.GOAL
    assert ours.time == pytest.approx(drake.times[-1], abs=0.3)
    for k, label in enumerate(ours.labels):
        there = np.searchsorted(drake.times, 0.4 * k - 1e-9)
        assert np.linalg.norm(label.state[:3] - drake.states[there, :3]) < 0.15


def test_each_flight_is_its_own(starts, world, labeler, flights):
    """A flight is the same whoever flies beside it, and ends at the goal."""
    alone = fly_planner(starts[1:], world, ExpertConfig(), labeler)[0]
    assert alone.time == flights[1].time
    assert alone.least_clearance == pytest.approx(flights[1].least_clearance, abs=1e-9)
    for a, b in zip(alone.labels, flights[1].labels, strict=True):
        np.testing.assert_allclose(a.state, b.state, atol=1e-9)
        np.testing.assert_allclose(a.plan.waypoints_B, b.plan.waypoints_B, atol=1e-8)
    last = flights[1].labels[-1].state[:3]
    assert np.linalg.norm(last - world.p_WG) < 0.4 * 2.0 + planner_flights.GOAL_RADIUS


def test_labels_keep_the_period_and_lead_on(world, flights):
    """There is one label for every 0.4 s of flight, cheapest trajectory first, which keeps clear of
    everything that the world has."""
    for flight in flights:
        assert flight.is_demonstration
        assert len(flight.labels) == np.ceil(flight.time / 0.4 - 1e-6)
        for label in flight.labels:
            assert isinstance(label.plan, Hypotheses)
            assert (np.diff(label.plan.costs) >= 0.0).all()
            way = label.plan.waypoints_W[0]
            assert (world.distance_field.distance(way) > VEHICLE_RADIUS).all()


def test_flights_that_fail_are_no_demonstrations(starts, world, labeler, monkeypatch):
    monkeypatch.setattr(planner_flights, "TIMEOUT", 0.8)
    low = starts[0] * [1, 1, 0] + [0, 0, VEHICLE_RADIUS - 0.05]
    slow, low = fly_planner(np.stack([starts[0], low]), world, ExpertConfig(), labeler)
    assert (slow.outcome, slow.is_demonstration) == (Outcome.TIMEOUT, False)
    assert slow.time == pytest.approx(0.8)
    assert (low.outcome, low.is_demonstration) == (Outcome.COLLISION, False)
    assert low.time < 0.1
    assert low.least_clearance < 0.0
