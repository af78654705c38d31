from types import SimpleNamespace

import numpy as np
import pytest

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import Outcome, fly
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.policies.planner import PrivilegedPlannerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.training.corpus.expert import ExpertConfig, Labeler, fly_planner, fly_policy

WORLD = ForestConfig(length=12.0, width=8.0, height=4.0)
REACTIVE = ExpertConfig(policy="reactive")


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


def test_planner_labels_every_period_of_its_and_other_flights(world, labeler, starts, flights):
    reactive = fly_policy(starts[1], world, REACTIVE, labeler)
    np.testing.assert_allclose(reactive.labels[0].state[:3], starts[1])
    for flight in (*flights, reactive):
        assert flight.outcome is Outcome.GOAL and flight.is_demonstration
        assert flight.min_clearance > 0.0
        assert len(flight.labels) == np.ceil(flight.time / 0.4 - 1e-6)
        for label in flight.labels:
            assert label.plan.waypoints_B.shape == (3, 10, 3)
            assert (np.diff(label.plan.costs) >= 0.0).all()
            p_WQ = label.plan.waypoints_W[0]
            assert (world.distance_field.distance(p_WQ) > VEHICLE_RADIUS).all()


def test_planner_flies_as_in_the_diagram(world, starts, flights):
    policy, start = PrivilegedPlannerConfig(rate=2.5), starts[0].tolist()
    scenario = Scenario(world=WORLD, start_radius=0.0, start=start, policy=policy)
    drake = fly(BuildFlightDiagram(scenario, world, camera=False))
    found = flights[0]
    assert found.outcome is drake.outcome is Outcome.GOAL
    assert found.time == pytest.approx(drake.times[-1], abs=0.3)
    rows = np.searchsorted(drake.times, 0.4 * np.arange(len(found.labels)) - 1e-9)
    p_WB = np.array([label.state[:3] for label in found.labels])
    assert np.linalg.norm(p_WB - drake.states[rows, :3], axis=1).max() < 0.15


def test_flights_are_independent(starts, world, labeler, flights):
    alone = fly_planner(starts[1:], world, ExpertConfig(), labeler)[0]
    assert alone.time == flights[1].time
    assert alone.min_clearance == pytest.approx(flights[1].min_clearance, abs=1e-9)
    for a, b in zip(alone.labels, flights[1].labels, strict=True):
        np.testing.assert_allclose(a.state, b.state, atol=1e-9)
        np.testing.assert_allclose(a.plan.waypoints_B, b.plan.waypoints_B, atol=1e-8)


def test_failed_flights_are_no_demonstrations(starts, world, labeler, monkeypatch):
    monkeypatch.setattr(Scenario, "timeout", 0.8)
    low = starts[0] * [1, 1, 0] + [0, 0, VEHICLE_RADIUS - 0.05]
    slow, low = fly_planner(np.stack([starts[0], low]), world, ExpertConfig(), labeler)
    assert (slow.outcome, slow.is_demonstration) == (Outcome.TIMEOUT, False)
    assert slow.time == pytest.approx(0.8)
    assert (low.outcome, low.is_demonstration) == (Outcome.COLLISION, False)
    assert low.time < 0.1 and low.min_clearance < 0.0


def test_states_without_a_path_are_not_labeled():
    wall = np.zeros((60, 20, 20), bool)
    wall[30] = True
    esdf = esdf_from_occupancy(wall, np.zeros_like(wall), np.zeros(3), 0.2)
    labeler = Labeler(esdf, np.array([10.0, 2.0, 2.0]), REACTIVE)
    before, behind = hover_state([8.0, 2.0, 2.0]), hover_state([3.0, 2.0, 2.0])
    [label] = labeler.labels([behind, before])
    np.testing.assert_array_equal(label.state, before)
    world = SimpleNamespace(distance_field=esdf)
    starts = np.stack([behind[:3], before[:3]])
    lost, flown = fly_planner(starts, world, ExpertConfig(), labeler)  # pyright: ignore
    assert (lost.outcome, lost.labels) == (Outcome.TIMEOUT, [])
    assert flown.outcome is Outcome.GOAL
