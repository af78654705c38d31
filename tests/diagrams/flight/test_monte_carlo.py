"""Where flights start in Drake's own simulations."""

import gc
import weakref

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import MonteCarloSimulation

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.flight.simulation import fly, random_flights
from splatpilot.systems.common.provenance import MONTE_CARLO_SEEDS
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant


def test_default_context_is_the_start_of_the_scenario(post_world):
    scenario = Scenario(timeout=1.0, seed=MONTE_CARLO_SEEDS[3])
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    start = sample_initial_state(scenario, post_world)
    state = diagram.GetOutputPort("state")
    np.testing.assert_array_equal(state.Eval(diagram.CreateDefaultContext()), start)
    plant = QuadrotorPlant(scenario.vehicle, start).ToAutoDiffXd()
    converted = plant.CreateDefaultContext().get_continuous_state_vector().CopyToVector()
    np.testing.assert_array_equal([x.value() for x in converted], start)

    flight = fly(diagram)
    simulator = random_flights(scenario, post_world)(lambda: 3)
    simulator.AdvanceTo(scenario.timeout)
    ended = simulator.get_system().GetOutputPort("state").Eval(simulator.get_context())
    np.testing.assert_array_equal(ended, flight.states[-1])


def test_monte_carlo_simulation_varies_what_the_scenario_varies(post_world):
    scenario = Scenario(timeout=0.3, start_radius=0.3, policy=policy_named("straight"))
    make = random_flights(scenario, post_world)

    def offset(diagram, context):
        plant = diagram.GetSubsystemByName("plant").GetMyContextFromRoot(context)
        return float(plant.get_continuous_state_vector().CopyToVector()[1])

    runs = [
        MonteCarloSimulation(make, offset, scenario.timeout, 5, RandomGenerator(1))
        for _ in range(2)
    ]
    first, second = ([result.output for result in results] for results in runs)
    assert first == second and len(set(first)) == 5
    again = MonteCarloSimulation(make, offset, 0.0, 1, runs[0][2].generator_snapshot)
    starts = MonteCarloSimulation(make, offset, 0.0, 5, RandomGenerator(1))
    assert again[0].output == starts[2].output
    assert max(abs(result.output - post_world.p_WS[1]) for result in starts) <= 0.3


def test_worlds_are_drawn_too_where_none_is_given():
    scenario = Scenario()
    scenario.world.length, scenario.world.width, scenario.world.voxel_size = 10.0, 6.0, 0.3
    make = random_flights(scenario)

    def clearance(diagram, context):
        return float(diagram.GetOutputPort("clearance").Eval(context)[0])

    results = MonteCarloSimulation(make, clearance, 0.0, 2, RandomGenerator(0))
    assert results[0].output != results[1].output


def test_a_simulation_ends_with_its_flight_and_is_freed(post_world):
    scenario = Scenario(timeout=20.0, policy=policy_named("straight"), goal=[4.0, 0.0, 1.5])
    scenario.start = [3.0, 0.0, 1.5]
    built = []
    make = random_flights(scenario, post_world)

    def remembered(generator):
        simulator = make(generator)
        built.append(weakref.ref(simulator.get_system()))
        return simulator

    time_of = MonteCarloSimulation(remembered, lambda _, c: c.get_time(), scenario.timeout, 1)
    assert 0.0 < time_of[0].output < scenario.timeout
    gc.collect()
    assert built[0]() is None
