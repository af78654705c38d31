"""One flight: how it starts, how it ends, and that it repeats."""

import dataclasses
import gc
import re
import weakref
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import EventStatus, LeafSystem

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.fly import flight_page
from splatpilot.diagrams.flight.monitor import flight_outcome
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.simulation import FlightError, Outcome, fly
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.systems.visualization.live import RESTART


def test_flies_round_the_post_to_the_goal(post_world):
    scenario = Scenario(timeout=20.0)
    seen = []
    flight = fly(BuildFlightDiagram(scenario, post_world), progress=seen.append)
    assert flight.outcome == Outcome.GOAL
    assert np.linalg.norm(flight.states[-1, :3] - post_world.p_WG) <= scenario.goal_radius
    post_distance = np.linalg.norm(flight.states[:, :2] - [5.0, 0.0], axis=1) - 0.5
    assert flight.clearances.min() == pytest.approx(post_distance.min() - VEHICLE_RADIUS, abs=1e-6)
    assert flight.clearances.min() > 0
    assert np.all(np.diff(flight.times) > 0)
    assert seen[-1] == flight.times[-1]

    summary: dict[str, Any] = flight.summary()
    assert summary["outcome"] == "goal"
    assert summary["flight_time_s"] == flight.times[-1]
    # At least the way there, and 0.1 m of start_radius and 0.3 m of goal_radius less.
    assert 7.6 < summary["path_length_m"] < 12.0
    assert summary["mean_speed_m_s"] == pytest.approx(
        summary["path_length_m"] / summary["flight_time_s"]
    )
    assert summary["real_time_factor"] == pytest.approx(flight.times[-1] / flight.wall_time)


def test_monitor_restarts_a_flight(post_world):
    diagram = BuildFlightDiagram(Scenario(timeout=1.0), post_world, camera=False)
    times = []

    def restart_once(context):
        times.append(context.get_time())
        again = times.count(0.0) == 1 and times[-1] > 0.2
        return EventStatus.ReachedTermination(diagram, RESTART) if again else None

    flight = fly(diagram, monitor=restart_once)
    assert times.count(0.0) == 2
    assert flight.outcome == Outcome.TIMEOUT and flight.times[0] == 0.0
    assert (np.diff(flight.times) > 0).all()


def test_flight_and_world_are_short_in_notebooks(post_world):
    scenario = Scenario(timeout=0.5)
    flight = fly(BuildFlightDiagram(scenario, post_world, camera=False))
    assert re.fullmatch(r"Flight\(timeout after 0.50 s, min. clearance \+\d.\d\d m\)", repr(flight))
    assert "<td>outcome</td><td>timeout</td>" in flight._repr_html_()
    assert len(repr(post_world)) < 80
    shown = flight_page(scenario, post_world, [flight])._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "&lt;title&gt;" in shown


def test_plans_are_recorded_as_flown(post_world):
    scenario = Scenario(timeout=1.0)
    flight = fly(BuildFlightDiagram(scenario, post_world))
    num_hypotheses = scenario.policy.lattice.num_hypotheses
    plans = [Hypotheses.from_vector(row, num_hypotheses) for row in flight.hypotheses]
    times = [plan.plan_time for plan in plans if plan is not None]
    np.testing.assert_allclose(times, np.arange(15) / 15, atol=1e-9)
    for plan in plans:
        assert plan is not None
        nearest = np.argmin(np.abs(flight.times - plan.plan_time))
        offset = plan.X_WB.translation() - flight.states[nearest, :3]
        assert np.linalg.norm(offset) <= 0.01 * 2.5  # Half a log period at top speed.


class Failing(LeafSystem):
    """Flies along x; raises `error` from 0.5 s on."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self._error = error
        self.DeclareVectorOutputPort("velocity", 3, self._calc, {self.time_ticket()})

    def _calc(self, context, output) -> None:
        if context.get_time() >= 0.5:
            raise self._error
        output.SetFromVector([1.0, 0.0, 0.0])


def test_an_exception_in_flight_keeps_the_record(post_world):
    scenario = Scenario(timeout=5.0)
    diagram = BuildFlightDiagram(scenario, post_world, policy=Failing(KeyError("depth")))
    message = r"at t = 0.5\d* s, p_WB = \[.*KeyError: 'depth'"
    with pytest.raises(FlightError, match=message) as raised:
        fly(diagram)
    flight = raised.value.flight
    assert flight.outcome == Outcome.ERROR
    assert isinstance(raised.value.__cause__, KeyError)
    assert 0.45 < flight.times[-1] <= 0.55
    assert len(flight.times) == len(flight.states) == len(flight.commands)
    assert flight.summary()["reason"] == flight.reason


def test_a_flight_that_becomes_infeasible_ends_with_an_error(post_world):
    scenario = Scenario(timeout=5.0)
    error = InfeasibleFlightError("no route leads to the goal")
    diagram = BuildFlightDiagram(scenario, post_world, policy=Failing(error))
    flight = fly(diagram)
    assert flight.outcome == Outcome.ERROR
    assert flight.reason.endswith("m/s: no route leads to the goal")


@pytest.mark.parametrize(
    ("p_WB", "outcome"),
    [
        ([5.0, 0.5 + VEHICLE_RADIUS - 0.01, 2.0], Outcome.COLLISION),
        ([5.0, 0.5 + VEHICLE_RADIUS + 0.01, 2.0], None),
        ([9.0, 0.0, 2.29], Outcome.GOAL),
        ([9.0, 0.0, 2.31], None),
        ([-0.01, 0.0, 2.0], Outcome.LEFT_VOLUME),
        ([1.0, 0.0, 4.01], Outcome.LEFT_VOLUME),
    ],
)
def test_outcome_at_an_instant(post_world, p_WB, outcome):
    scenario = Scenario()
    diagram = BuildFlightDiagram(scenario, post_world)
    context = diagram.CreateDefaultContext()
    plant = diagram.GetSubsystemByName("plant")
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover_state(p_WB))
    assert flight_outcome(diagram, context, post_world.p_WG, scenario.goal_radius) == outcome


def test_collision_ends_the_flight(post_world):
    nothing = np.full_like(post_world.esdf.distances, 5.0)
    empty = dataclasses.replace(
        post_world.esdf, distances=nothing, states=np.zeros(nothing.shape, np.uint8)
    )
    world = dataclasses.replace(post_world, esdf=empty)
    scenario = Scenario(start_radius=0.0)
    flight = fly(BuildFlightDiagram(scenario, world))
    assert flight.outcome == Outcome.COLLISION
    assert -0.1 < flight.clearances[-1] < 0
    assert flight.clearances[:-1].min() >= 0


def test_timeout_ends_the_flight(post_world):
    scenario = Scenario(timeout=0.5)
    flight = fly(BuildFlightDiagram(scenario, post_world))
    assert flight.outcome == Outcome.TIMEOUT
    assert flight.times[-1] == pytest.approx(0.5)


def test_start_is_drawn_from_the_seed(post_world):
    states = [sample_initial_state(Scenario(seed=seed), post_world) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(states[0], states[1])
    assert np.any(states[0] != states[2])
    for state in states:
        assert np.linalg.norm(state[:3] - post_world.p_WS) <= 0.1
        assert np.all(state[3:6] == 0)
        assert abs(state[9]) < 0.02  # Facing the goal along +x.


@pytest.mark.parametrize(
    ("field", "point", "message"),
    [
        ("start", [5.0, 0.0, 2.0], r"start \[5.0, 0.0, 2.0\] is -0.500 m from the nearest surface"),
        ("start", [5.0, 0.8, 2.0], r"0.300 m from the nearest surface.*radius is 0.354 m"),
        ("goal", [11.0, 0.0, 2.0], r"goal \[11.0, 0.0, 2.0\] is outside the world.*\[10.0, 3.0"),
    ],
)
def test_start_and_goal_need_room(post_world, field, point, message):
    with pytest.raises(ValueError, match=message):
        sample_initial_state(Scenario(**{field: point}), post_world)


def test_a_flight_that_starts_at_its_goal_is_refused(post_world):
    start = [float(x) for x in post_world.p_WS]
    near = [start[0] + 0.25, *start[1:]]
    with pytest.raises(ValueError, match=r"goal_radius, 0\.3 m, got 0\.25 m"):
        sample_initial_state(Scenario(goal=near), post_world)
    sample_initial_state(Scenario(goal=near, goal_radius=0.2), post_world)


@pytest.mark.parametrize("seed", [10, 11])
def test_forests_are_flown_through_at_nominal_speed(seed):
    scenario = Scenario(seed=seed)
    world = make_world(scenario.world, scenario.seed)
    flight = fly(BuildFlightDiagram(scenario, world))
    assert flight.outcome == Outcome.GOAL
    assert np.nanmin(flight.clearances) > 0
    summary: dict[str, Any] = flight.summary()
    assert summary["mean_speed_m_s"] > 1.7


@pytest.mark.parametrize("name", ["planner", "reactive"])
def test_flown_diagrams_are_freed(name, post_world):
    noise = ObservationNoise(depth_additive=0.01, latency=0.02)
    scenario = Scenario(timeout=0.2, policy=policy_named(name), observation=noise)
    diagram = BuildFlightDiagram(scenario, post_world)
    fly(diagram)
    references = [weakref.ref(system) for system in (diagram, *diagram.GetSystems())]
    assert references[0]() is diagram
    del diagram
    gc.collect()
    assert [reference() for reference in references if reference() is not None] == []
