import gc
import re
import weakref
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from pydrake.common import RandomGenerator
from pydrake.gym import DrakeGymEnv
from pydrake.systems.analysis import MonteCarloSimulation
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem

from splatpilot.diagrams.flight.flight_diagram import AddFlight, BuildFlightDiagram
from splatpilot.diagrams.flight.fly import flight_page
from splatpilot.diagrams.flight.monitor import flight_outcome
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.simulation import (
    FlightError,
    Outcome,
    fly,
    fly_all,
    random_flights,
)
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.provenance import MONTE_CARLO_SEEDS, InfeasibleFlightError
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import (
    VEHICLE_RADIUS,
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
)
from splatpilot.systems.visualization.live import RESTART


@pytest.fixture(scope="module")
def flight(post_world):
    seen = []
    flight = fly(BuildFlightDiagram(Scenario(), post_world), progress=seen.append)
    assert seen[-1] == flight.times[-1]
    return flight


def test_flies_round_the_post_to_the_goal(post_world, flight):
    assert flight.outcome == Outcome.GOAL
    post_distance = np.linalg.norm(flight.states[:, :2] - [5.0, 0.0], axis=1) - 0.5
    assert flight.clearances.min() == pytest.approx(post_distance.min() - VEHICLE_RADIUS, abs=1e-6)
    assert flight.clearances.min() > 0

    summary: dict[str, Any] = flight.summary()
    assert (summary["outcome"], summary["flight_time_s"]) == ("goal", flight.times[-1])
    # At least the way there, and 0.1 m of start_radius and 0.3 m of goal_radius less.
    assert 7.6 < summary["path_length_m"] < 12.0
    speed = summary["path_length_m"] / summary["flight_time_s"]
    assert summary["mean_speed_m_s"] == pytest.approx(speed)
    assert summary["real_time_factor"] == pytest.approx(flight.times[-1] / flight.wall_time)


def test_plans_are_recorded_as_flown(flight):
    num_hypotheses = Scenario().policy.lattice.num_hypotheses
    plans = [Hypotheses.from_vector(row, num_hypotheses) for row in flight.hypotheses]
    count = np.floor(15 * flight.times[-1]) + 1
    np.testing.assert_allclose([p.plan_time for p in plans], np.arange(count) / 15, atol=1e-9)
    for plan in plans:
        nearest = np.argmin(np.abs(flight.times - plan.plan_time))
        offset = plan.X_WB.translation() - flight.states[nearest, :3]
        assert np.linalg.norm(offset) <= 0.01 * 2.5  # Half a log period at top speed.


@pytest.mark.parametrize("interrupted_at", [np.inf, 0.4])
def test_a_restarted_flight_is_the_second_one(post_world, interrupted_at):
    diagram = BuildFlightDiagram(Scenario(timeout=0.5), post_world, camera=False)
    times = []

    def watch(context):
        times.append(context.get_time())
        if times.count(0.0) == 2 and times[-1] > interrupted_at:
            raise KeyboardInterrupt
        again = times.count(0.0) == 1 and times[-1] > 0.2
        return EventStatus.ReachedTermination(diagram, RESTART) if again else None

    try:
        flight = fly(diagram, monitor=watch)
    except KeyboardInterrupt as interruption:
        flight = vars(interruption)["flight"]
    ends = {np.inf: (Outcome.TIMEOUT, 0.5), 0.4: (Outcome.INTERRUPTED, times[-1])}
    assert (flight.outcome, flight.times[-1]) == pytest.approx(ends[interrupted_at])
    assert times.count(0.0) == 2 and flight.times[0] == 0.0
    assert (np.diff(flight.times) > 0).all()


def test_the_smallest_step_is_that_of_all_flights(post_world):
    agile = Scenario(timeout=0.5, vehicle=QuadrotorParams(motor_time_constant=0.005))
    agile.simulator.max_step_size, agile.start = 0.005, [1.0, 1.5, 2.0]
    for first, second in ((Scenario(timeout=0.5), agile), (agile, Scenario(timeout=0.5))):
        builder = DiagramBuilder()
        parts = AddFlight(builder, first, post_world, name="a", camera=False)
        AddFlight(builder, second, post_world, name="b", camera=False, others=[parts])
        flights = fly_all(builder.Build())
        assert {flight.outcome for flight in flights.values()} == {Outcome.TIMEOUT}


def test_flights_of_nested_diagrams_need_different_names(post_world):
    builder = DiagramBuilder()
    for name in "ab":
        diagram = BuildFlightDiagram(Scenario(timeout=0.5), post_world, camera=False)
        builder.AddNamedSystem(name, diagram)
    with pytest.raises(ValueError, match="names of FlightMonitors must be different"):
        fly_all(builder.Build())


def test_a_policy_keeps_its_configuration(post_world):
    scenario = Scenario(timeout=0.5, policy=policy_named("straight", 1.0))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    scenario.policy.speed = 3.0
    assert np.linalg.norm(fly(diagram).states[:, 3:6], axis=1).max() < 1.1


def test_flight_and_world_are_short_in_notebooks(post_world, flight):
    assert re.fullmatch(r"Flight\(goal after \d.\d\d s, min. clearance \+\d.\d\d m\)", repr(flight))
    assert "<td>outcome</td><td>goal</td>" in flight._repr_html_()
    assert len(repr(post_world)) < 80
    shown = flight_page(Scenario(), post_world, [flight])._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "&lt;title&gt;" in shown


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


@pytest.mark.parametrize("error", [KeyError("depth"), InfeasibleFlightError("no route leads")])
def test_an_exception_in_flight_keeps_the_record(post_world, error):
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False, policy=Failing(error))
    if isinstance(error, KeyError):
        message = r"at t = 0.5\d* s, p_WB = \[.*KeyError: 'depth'"
        with pytest.raises(FlightError, match=message) as raised:
            fly(diagram)
        flight = raised.value.flight
        assert isinstance(raised.value.__cause__, KeyError)
    else:
        flight = fly(diagram)
        assert flight.reason.endswith("m/s: no route leads")
    assert flight.outcome == Outcome.ERROR and flight.summary()["reason"] == flight.reason
    assert 0.45 < flight.times[-1] <= 0.55
    assert len(flight.times) == len(flight.states) == len(flight.commands)


def test_outcome_at_an_instant(post_world):
    diagram = BuildFlightDiagram(Scenario(), post_world, camera=False)
    context = diagram.CreateDefaultContext()
    for p_WB, outcome in (
        ([5.0, 0.5 + VEHICLE_RADIUS - 0.01, 2.0], Outcome.COLLISION),
        ([5.0, 0.5 + VEHICLE_RADIUS + 0.01, 2.0], None),
        ([9.0, 0.0, 2.29], Outcome.GOAL),
        ([9.0, 0.0, 2.31], None),
        ([-0.01, 0.0, 2.0], Outcome.LEFT_VOLUME),
        ([1.0, 0.0, 4.01], Outcome.LEFT_VOLUME),
    ):
        context.SetContinuousState(hover_state(p_WB))
        assert flight_outcome(diagram, context, post_world.p_WG, 0.3) == outcome, p_WB


def test_start_is_drawn_from_the_seed(post_world):
    states = [sample_initial_state(Scenario(seed=seed), post_world) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(states[0], states[1])
    assert np.any(states[0] != states[2])
    for state in states:
        assert np.linalg.norm(state[:3] - post_world.p_WS) <= 0.1
        assert not state[3:6].any() and abs(state[9]) < 0.02  # Facing the goal along +x.


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"start": [5.0, 0.0, 2.0]},
            r"start \[5.0, 0.0, 2.0\] is -0.500 m from the nearest surface",
        ),
        ({"start": [5.0, 0.8, 2.0]}, r"0.300 m from the nearest surface.*radius is 0.354 m"),
        ({"goal": [11.0, 0.0, 2.0]}, r"goal \[11.0, 0.0, 2.0\] is outside the world.*\[10.0, 3.0"),
        ({"goal": [1.25, 0.0, 2.0]}, r"goal_radius, 0\.3 m, got 0\.25 m"),
    ],
)
def test_start_and_goal_need_room(post_world, fields, message):
    with pytest.raises(ValueError, match=message):
        sample_initial_state(Scenario(**fields), post_world)
    if fields == {"goal": [1.25, 0.0, 2.0]}:
        sample_initial_state(Scenario(**fields, goal_radius=0.2), post_world)


def test_a_forest_is_flown_through_at_nominal_speed():
    scenario = Scenario(seed=10)
    scenario.world.length = 20.0
    world = make_world(scenario.world, scenario.seed)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False))
    assert flight.outcome == Outcome.GOAL
    assert np.nanmin(flight.clearances) > 0
    assert flight.summary()["mean_speed_m_s"] > 1.7


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


def test_default_context_is_the_start_of_the_scenario(post_world):
    scenario = Scenario(timeout=0.5, seed=MONTE_CARLO_SEEDS[3])
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    start = sample_initial_state(scenario, post_world)
    state = diagram.GetOutputPort("state")
    np.testing.assert_array_equal(state.Eval(diagram.CreateDefaultContext()), start)
    plant = QuadrotorPlant(scenario.vehicle, start).ToAutoDiffXd()
    converted = plant.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    np.testing.assert_array_equal([x.value() for x in converted], start)
    simulator = random_flights(scenario, post_world)(lambda: 3)
    simulator.AdvanceTo(scenario.timeout)
    ended = simulator.get_system().GetOutputPort("state").Eval(simulator.get_context())
    np.testing.assert_array_equal(ended, fly(diagram).states[-1])


def test_monte_carlo_simulation_varies_what_the_scenario_varies(post_world):
    scenario = Scenario(timeout=0.2, start_radius=0.3, policy=policy_named("straight"))
    small = Scenario()
    small.world.length, small.world.width, small.world.voxel_size = 10.0, 6.0, 0.3
    make = random_flights(scenario, post_world)

    def simulated(make, port, element, duration, count, seed=1):
        def output(diagram, context):
            return float(diagram.GetOutputPort(port).Eval(context)[element])

        generator = RandomGenerator(seed) if isinstance(seed, int) else seed
        return MonteCarloSimulation(make, output, duration, count, generator)

    runs = [simulated(make, "state", 1, 0.2, 5) for _ in range(2)]
    first, second = ([result.output for result in results] for results in runs)
    assert first == second and len(set(first)) == 5
    again = simulated(make, "state", 1, 0.0, 1, runs[0][2].generator_snapshot)
    starts = simulated(make, "state", 1, 0.0, 5)
    assert again[0].output == starts[2].output
    assert max(abs(result.output - post_world.p_WS[1]) for result in starts) <= 0.3
    built = random_flights(scenario, post_world, build=BuildFlightDiagram)
    assert [each.output for each in simulated(built, "state", 1, 0.2, 5)] == first
    worlds = simulated(random_flights(small), "clearance", 0, 0.0, 2)
    assert worlds[0].output != worlds[1].output


def test_drakes_environment_acts_through_the_decision(post_world):
    env = DrakeGymEnv(
        random_flights(Scenario(timeout=1.0), post_world, policy="velocity"),
        time_step=0.1,
        action_space=Box(-1.0, 1.0, (3,)),
        observation_space=Box(-np.inf, np.inf, (13,)),
        reward=lambda system, context: 0.0,
        action_port_id="velocity",
        observation_port_id="observation_state",
    )
    env.reset(seed=1)
    steps = (env.step(np.array([1.0, 0.0, 0.0])) for _ in range(20))
    ended = next(observation for observation, _, terminated, _, _ in steps if terminated)
    assert ended[0] > 1.4


def test_a_simulation_ends_with_its_flight_and_is_freed(post_world):
    ends = {"start": [3.0, 0.0, 1.5], "goal": [4.0, 0.0, 1.5]}
    scenario = Scenario(timeout=20.0, policy=policy_named("straight"), **ends)
    make, built = random_flights(scenario, post_world), []

    def remembered(generator):
        simulator = make(generator)
        built.append(weakref.ref(simulator.get_system()))
        return simulator

    results = MonteCarloSimulation(remembered, lambda _, c: c.get_time(), scenario.timeout, 1)
    assert 0.0 < results[0].output < scenario.timeout
    gc.collect()
    assert built[0]() is None
