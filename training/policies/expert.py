"""Rollouts to imitate: an expert flies, and along its flight says what the best ways are."""

from dataclasses import dataclass, replace

import numpy as np

from splatpilot.diagrams.flight import Flight, Outcome, fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.policies.privileged_planner import plan
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.policies.trajectory_lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams


@dataclass
class ExpertConfig:
    """Who flies, how fast, and how often is asked."""

    # A policy of the benchmark: `planner`, which knows the way, or one that flies by depth.
    policy: str = "planner"
    # [m/s]
    speed: float = 2.0
    # [s] Between two labelled states.
    period: float = 0.4
    # [-] Trajectories a state is labelled with, K.
    num_hypotheses: int = 3

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        policy_named(self.policy, self.speed)
        if not 0.02 <= self.period <= 10.0:
            raise ValueError(f"period is {self.period} s; it must be 0.02 to 10")
        LatticeConfig(speed=self.speed, num_hypotheses=self.num_hypotheses).validate()


@dataclass(frozen=True, eq=False)
class ExpertRollout:
    """A flight that reached its goal with positive clearance, and labels along it."""

    flight: Flight
    p_WG: np.ndarray  # (3,) [m]
    states: np.ndarray  # (n, 13), one every `period`
    waypoints_B: np.ndarray  # (n, K, 10, 3) [m], each state's best trajectories, cheapest first
    costs: np.ndarray  # (n, K)


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
        self._field = esdf if esdf.occupied_outside else esdf.conservative()
        lattice = LatticeConfig(speed=config.speed, num_hypotheses=config.num_hypotheses)
        self._lattice = TrajectoryLattice(lattice)
        self._toa: TimeOfArrival = time_of_arrival(self._field, p_WG, lattice.margin)
        self._params = params

    def label(self, time: float, state: np.ndarray) -> Hypotheses:
        """The K best distinct trajectories from a state (13,), cheapest first.

        Raises:
            ValueError: if no way leads to the goal from there.
        """
        return plan(time, state, self._field, self._toa, self._lattice, self._params)


def expert_rollout(scenario: Scenario, world: World, config: ExpertConfig) -> ExpertRollout | None:
    """Flies `scenario` in `world` with the expert, and labels the states of its flight.

    Start and goal are the scenario's, or else the world's; `draw_start_and_goal` draws others from
    a distance field.

    Returns:
        The rollout, or None if the flight did not reach the goal or touched anything.

    Raises:
        ValueError: on a config out of range, or a scenario that cannot be flown.
    """
    config.validate()
    scenario = replace(scenario, policy=policy_named(config.policy, config.speed))
    scenario.validate()
    labeller = Labeller(world.esdf, goal_of(scenario, world), config, scenario.vehicle)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
    if flight.outcome is not Outcome.GOAL or not np.nanmin(flight.clearances) > 0.0:
        return None
    times = np.arange(0.0, flight.times[-1], config.period)
    rows = np.searchsorted(flight.times, times - 1e-9)
    labels = [labeller.label(float(flight.times[row]), flight.states[row]) for row in rows]
    return ExpertRollout(
        flight,
        goal_of(scenario, world),
        flight.states[rows],
        np.stack([label.waypoints_B for label in labels]),
        np.stack([label.costs for label in labels]),
    )
