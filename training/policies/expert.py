"""The expert to imitate: who flies, and what the best ways are from any state."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splatpilot.diagrams.flight import Outcome, fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.policies.hypotheses import (
    NUM_WAYPOINTS,
    WAYPOINT_PERIOD,
    Hypotheses,
)
from splatpilot.systems.policies.privileged_planner import plan
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.policies.trajectory_lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams

PLANNER = "planner"

_LONGEST = NUM_WAYPOINTS * WAYPOINT_PERIOD - FlatnessControllerConfig.lookahead  # [s]


class Label(NamedTuple):
    """A state and the best trajectories from it."""

    state: np.ndarray  # (13,)
    plan: Hypotheses  # cheapest first


@dataclass
class ExpertConfig:
    """Who flies, how fast, and how often is asked."""

    # `planner`, which knows the way, or a policy of the benchmark that flies by depth, or a file of
    # weights.
    policy: str = PLANNER
    # [m/s] Nominal speed of the expert.
    speed: float = 2.0
    # [s] Between two labelled states; when the planner flies, also between two of its plans.
    period: float = 0.4
    # [-] Trajectories a state is labelled with, K.
    num_hypotheses: int = 3

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        policy_named(self.policy, self.speed)
        if not 0.02 <= self.period <= _LONGEST:
            raise ValueError(
                f"expert.period is {self.period} s; it must be 0.02 to {_LONGEST:g}, as plans last "
                "1 s and the controller looks 0.4 s ahead"
            )
        self.lattice().validate()

    def lattice(self) -> LatticeConfig:
        """Of the planner, which labels, and flies if it is the expert."""
        return LatticeConfig(speed=self.speed, num_hypotheses=self.num_hypotheses)


@dataclass(frozen=True, eq=False)
class ExpertFlight:
    """A flight of the expert, and what it would do from states along it."""

    outcome: Outcome
    time: float  # [s] that it took
    least_clearance: float  # [m]
    labels: list[Label]  # of states along it, one every `period`

    @property
    def is_demonstration(self) -> bool:
        """Whether it reached its goal and touched nothing."""
        return self.outcome is Outcome.GOAL and self.least_clearance > 0.0


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
        self._lattice, self._params = TrajectoryLattice(config.lattice()), params
        self.field = esdf if esdf.occupied_outside else esdf.conservative()
        self.toa = time_of_arrival(self.field, p_WG, config.lattice().margin)

    def label(self, time: float, state: np.ndarray) -> Hypotheses:
        """The K best distinct trajectories from a state (13,), cheapest first.

        Raises:
            ValueError: if no way leads to the goal from there.
        """
        return plan(time, state, self.field, self.toa, self._lattice, self._params)

    def labels(self, states: Iterable[np.ndarray]) -> list[Label]:
        """States (13,) with their trajectories, less those that no way leads on from."""
        labels = []
        for state in states:
            try:
                labels.append(Label(state, self.label(0.0, state)))
            except InfeasibleFlightError:
                continue
        return labels


def fly_policy(
    scenario: Scenario, world: World, config: ExpertConfig, labeller: Labeller
) -> ExpertFlight:
    """Flies `scenario` in `world` by the expert's policy, as in the benchmark.

    Raises:
        ValueError: on a scenario that cannot be flown.
    """
    scenario = replace(scenario, policy=policy_named(config.policy, config.speed))
    scenario.validate()
    flight = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
    times = np.arange(0.0, flight.times[-1], config.period)
    return ExpertFlight(
        flight.outcome,
        float(flight.times[-1]),
        float(np.nanmin(flight.clearances)),
        labeller.labels(flight.states[np.searchsorted(flight.times, times - 1e-9)]),
    )
