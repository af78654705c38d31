"""The expert to imitate: its flights, and the best trajectories from any state."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import ceil
from typing import NamedTuple

import numpy as np

from splatpilot.diagrams.flight.flight import Outcome, fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD, Hypotheses
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.planner import plan
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.vehicle.flatness import (
    FlatnessControllerConfig,
    flatness_command,
    reaching_acceleration,
)
from splatpilot.systems.vehicle.quadrotor import (
    VEHICLE_RADIUS,
    QuadrotorParams,
    hover_state,
    rk4_step,
)
from splatpilot.systems.vehicle.state import QuadrotorState, lengths

PLANNER = "planner"

_LONGEST = NUM_WAYPOINTS * WAYPOINT_PERIOD - FlatnessControllerConfig.lookahead  # [s]


class Label(NamedTuple):
    """A state and the best trajectories from it."""

    state: np.ndarray  # (13,)
    plan: Hypotheses  # cheapest first


@dataclass
class ExpertConfig(Config):
    """The expert's policy, speed and labels."""

    # `planner`, which knows the world, a policy of the benchmark that flies by depth, or a file of
    # weights.
    policy: str = PLANNER
    # [m/s] Nominal speed of the expert.
    speed: float = 2.0
    # [s] Time between labeled states, and between plans of a planner that flies. Plans last 1 s, of
    # which the controller looks 0.4 s ahead.
    period: float = bounded(0.4, f"[0.02, {_LONGEST:g}] s")
    # [-] Trajectories of each label, K.
    num_hypotheses: int = 3

    def check(self) -> None:
        policy_named(self.policy, self.speed)
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


class Labeler:
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
    scenario: Scenario, world: World, config: ExpertConfig, labeler: Labeler
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
        labeler.labels(flight.states[np.searchsorted(flight.times, times - 1e-9)]),
    )


GOAL_RADIUS = 0.3  # [m]
TIMEOUT = 60.0  # [s]

_STEP = 0.02  # [s], at most, between two commands


def fly_planner(
    p_WS: np.ndarray, world: World, config: ExpertConfig, labeler: Labeler
) -> list[ExpertFlight]:
    """Flies from each of the starts p_WS (N, 3) [m] to the labeler's goal.

    The vehicles have the equations of the simulated plant and the law of its controller; a step of
    many costs as much as one of one. They look along their way, and fly by their labels: a plan
    every 0.4 s leads to the goal as safely as one every 0.07 s.

    Raises:
        ValueError: if no way leads to the goal from a state along a flight.
    """
    control, params, p_WG = FlatnessControllerConfig(), QuadrotorParams(), labeler.toa.p_WG
    substeps = ceil(config.period / _STEP - 1e-9)
    dt = config.period / substeps
    yaws = np.arctan2(p_WG[1] - p_WS[:, 1], p_WG[0] - p_WS[:, 0])
    states = np.stack([hover_state(p, yaw) for p, yaw in zip(p_WS, yaws, strict=True)])
    flying = np.arange(len(p_WS))
    outcomes = [Outcome.TIMEOUT] * len(p_WS)
    traces: list[list[np.ndarray]] = [[p] for p in p_WS]
    labels: list[list[Label]] = [[] for _ in p_WS]
    for number in range(ceil(TIMEOUT / config.period)):
        if not len(flying):
            break
        ways = np.empty((len(flying), NUM_WAYPOINTS + 1, 3))
        for row, (n, state) in enumerate(zip(flying, states, strict=True)):
            plan = labeler.label(number * config.period, state)
            labels[n].append(Label(state, plan))
            ways[row] = np.vstack([state[:3], plan.waypoints_W[plan.best]])
        for step in range(substeps):
            p_WB, v_WB, _, _ = QuadrotorState.of(states)
            p_WR = _along(ways, step * dt + control.lookahead)
            a_WB = reaching_acceleration(p_WR, p_WB, v_WB, control.lookahead)
            heading = np.arctan2(p_WR[:, 1] - p_WB[:, 1], p_WR[:, 0] - p_WB[:, 0])
            command = flatness_command(states, a_WB, v_WB, heading, control, params)
            states = rk4_step(states, command, params, dt)
            p_WB = QuadrotorState.of(states).p_WB
            for n, p in zip(flying, p_WB, strict=True):
                traces[n].append(p)
            arrived = lengths(p_WB - p_WG)[:, 0] <= GOAL_RADIUS
            touched = labeler.field.distance(p_WB) < VEHICLE_RADIUS
            for n in flying[arrived]:
                outcomes[n] = Outcome.GOAL
            for n in flying[touched]:
                outcomes[n] = Outcome.COLLISION
            going = ~(arrived | touched)
            flying, ways, states = flying[going], ways[going], states[going]
    return [
        ExpertFlight(outcome, dt * (len(trace) - 1), _least_clearance(np.stack(trace), world), own)
        for outcome, trace, own in zip(outcomes, traces, labels, strict=True)
    ]


def _least_clearance(p_WB: np.ndarray, world: World) -> float:
    """[m], of a path (n, 3) [m]."""
    return float(np.nanmin(world.distance_field.distance(p_WB))) - VEHICLE_RADIUS


def _along(ways: np.ndarray, time: float) -> np.ndarray:
    """Points (n, 3) [m] of ways (n, 11, 3) at a time [s] since they began, then their ends."""
    last = ways.shape[1] - 2
    i = min(int(time / WAYPOINT_PERIOD), last)
    part = min(time / WAYPOINT_PERIOD - i, 1.0)
    return ways[:, i] + part * (ways[:, i + 1] - ways[:, i])
