"""Random flights for Drake's `RandomSimulation` and `MonteCarloSimulation`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import System

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.diagrams.flight.simulation import make_flight_simulator
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.seeds import MONTE_CARLO_SEEDS


def random_flights(
    scenario: Scenario,
    world: World | None = None,
    **systems: str | Callable[[Scenario, World], System],
) -> Callable[[RandomGenerator], Simulator]:
    """Makes simulators of flights with random seeds: starts, noise, latency and worlds differ.

        def clearance(diagram, context):
            return diagram.GetOutputPort("clearance").Eval(context)[0]

        MonteCarloSimulation(random_flights(scenario), clearance, scenario.timeout, 20)

    Seeds are of `MONTE_CARLO_SEEDS`. The Context is the start of the flight, and a simulation ends
    with it, see `FlightMonitor`.

    Args:
        scenario: of the flights; each replaces its seed.
        world: of all flights; by default made of each seed, which is slow.
        systems: arguments of `BuildFlightDiagram` such as `policy="velocity"`; functions of
            scenario and world make a system for each flight.

    Returns:
        The `make_simulator` of these functions, which raises `InfeasibleFlightError` for a world
        without clearance at its start or goal.
    """

    def make_simulator(generator: RandomGenerator) -> Simulator:
        seed = MONTE_CARLO_SEEDS[generator() % len(MONTE_CARLO_SEEDS)]
        sample = sample_scenario(replace(scenario, seed=seed))
        flown = world or make_world(sample.world, sample.seed)
        made: dict[str, Any] = {
            name: system if isinstance(system, str) else system(sample, flown)
            for name, system in systems.items()
        }
        return make_flight_simulator(BuildFlightDiagram(sample, flown, camera=False, **made))

    return make_simulator
