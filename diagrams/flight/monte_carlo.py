"""Flights drawn at random, for Drake's `RandomSimulation` and `MonteCarloSimulation`."""

from collections.abc import Callable
from dataclasses import replace

from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.flight.flight import flight_simulator
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.seeds import MONTE_CARLO_SEEDS


def random_flights(
    scenario: Scenario, world: World | None = None
) -> Callable[[RandomGenerator], Simulator]:
    """
    Makes simulators of flights that differ in all that a scenario draws from its seed: where the
    vehicle starts, the noise of what its policy sees and when that comes, and the world.

        def clearance(diagram, context):
            return diagram.GetOutputPort("clearance").Eval(context)[0]

        MonteCarloSimulation(random_flights(scenario), clearance, scenario.timeout, 20)

    Each draw is one of `MONTE_CARLO_SEEDS`; the default Context of the diagram is the start of its
    flight. A simulation ends with its flight: reaching the goal, colliding or leaving the volume.

    Args:
        scenario: what is flown; its own seed does not matter.
        world: what all fly in; made anew from each seed if None, which is slow.

    Returns:
        The `make_simulator` of these functions, which raises `InfeasibleFlightError` for a world
        without room at its start or goal.
    """

    def make_simulator(generator: RandomGenerator) -> Simulator:
        drawn = replace(scenario, seed=MONTE_CARLO_SEEDS[generator() % len(MONTE_CARLO_SEEDS)])
        flown = world or make_world(drawn.world, drawn.seed)
        diagram = BuildFlightDiagram(drawn, flown, camera=False)
        return flight_simulator(diagram, drawn, flown)

    return make_simulator
