"""The expert to imitate: who flies, and what the best ways are from any state."""

from dataclasses import dataclass, replace

import numpy as np

from splatpilot.diagrams.flight import Flight, Outcome, fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.privileged_planner import (
    PrivilegedPlanner,
    PrivilegedPlannerConfig,
    plan,
)
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.policies.trajectory_lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams

PLANNER = "planner"


@dataclass
class ExpertConfig:
    """Who flies, how fast, and how often is asked."""

    # `planner`, which knows the way, or a policy of the benchmark that flies by depth, or a file of
    # weights.
    policy: str = PLANNER
    # [m/s]
    speed: float = 2.0
    # [Hz] Plans a second of the planner in flight: fewer than in the benchmark, as nothing moves.
    rate: float = 5.0
    # [s] Between two labelled states.
    period: float = 0.4
    # [-] Trajectories a state is labelled with, K.
    num_hypotheses: int = 3

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        policy_named(self.policy, self.speed)
        if not 0.02 <= self.period <= 10.0:
            raise ValueError(f"period is {self.period} s; it must be 0.02 to 10")
        self.planner().validate()

    def planner(self) -> PrivilegedPlannerConfig:
        """The planner that labels, and flies if it is the expert."""
        lattice = LatticeConfig(speed=self.speed, num_hypotheses=self.num_hypotheses)
        return PrivilegedPlannerConfig(rate=self.rate, lattice=lattice)


class Labeller:
    """What the best trajectories are from any state of a place: the planner with its global hint.

    Args:
        esdf: the place; unknown space counts as occupied.
        p_WG: the goal (3,) [m].
        config: speed and number of trajectories.
        params: the vehicle's.

    Raises:
        ValueError: if the goal is not in free space.
    """

    def __init__(
        self,
        esdf: Esdf,
        p_WG: np.ndarray,
        config: ExpertConfig,
        params: QuadrotorParams | None = None,
    ) -> None:
        self.planner, self._params = config.planner(), params
        self.field = esdf if esdf.occupied_outside else esdf.conservative()
        self.toa = time_of_arrival(self.field, p_WG, self.planner.lattice.margin)
        self._lattice = TrajectoryLattice(self.planner.lattice)

    def label(self, time: float, state: np.ndarray) -> Hypotheses:
        """The K best distinct trajectories from a state (13,), cheapest first.

        Raises:
            ValueError: if no way leads to the goal from there.
        """
        return plan(time, state, self.field, self.toa, self._lattice, self._params)


def fly_expert(
    scenario: Scenario, world: World, config: ExpertConfig, labeller: Labeller
) -> Flight:
    """Flies `scenario` in `world` to the labeller's goal with the expert.

    The flight ends where the grid of distances says so; its clearances are those of `world`.

    Raises:
        ValueError: on a scenario that cannot be flown.
    """
    scenario = replace(
        scenario,
        policy=policy_named(config.policy, config.speed),
        goal=labeller.toa.p_WG.tolist(),
    )
    scenario.validate()
    planner = None
    if config.policy == PLANNER:
        planner = PrivilegedPlanner(
            labeller.field, labeller.planner, scenario.vehicle, toa=labeller.toa
        )
    # The grid takes a fraction of the time that many shapes do.
    gridded = replace(world, distance_field=world.esdf)
    diagram = BuildFlightDiagram(scenario, gridded, camera=False, policy=planner)
    return fly(diagram, scenario, world)


def is_demonstration(flight: Flight) -> bool:
    """Whether a flight reached its goal and touched nothing."""
    return flight.outcome is Outcome.GOAL and bool(np.nanmin(flight.clearances) > 0.0)
