"""The expert to imitate: its flights, and the best trajectories from any state."""

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import Outcome, fly
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

_MAX_PERIOD = NUM_WAYPOINTS * WAYPOINT_PERIOD - FlatnessControllerConfig.lookahead  # [s]
_STEP = 0.02  # [s], at most, between two commands


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
    # [s] Time between labeled states, and between plans of a planner that flies. Plans last 1 s;
    # the controller follows them 0.4 s ahead.
    period: float = bounded(0.4, f"[0.02, {_MAX_PERIOD:g}] s")
    # [-] Trajectories of each label, K.
    num_hypotheses: int = 3

    def check(self) -> None:
        policy_named(self.policy, self.speed)
        self.lattice().validate()

    def lattice(self) -> LatticeConfig:
        """Returns the lattice of the planner that labels, and that flies if it is the expert."""
        return LatticeConfig(speed=self.speed, num_hypotheses=self.num_hypotheses)


class ExpertFlight(NamedTuple):
    """A flight of the expert, and labels of states along it."""

    outcome: Outcome
    time: float  # [s], duration
    min_clearance: float  # [m]
    labels: list[Label]  # one every `ExpertConfig.period`

    @property
    def is_demonstration(self) -> bool:
        """Tells whether it reached its goal without contact."""
        return self.outcome is Outcome.GOAL and self.min_clearance > 0.0


class Labeler:
    """Plans trajectories from any state to the goal p_WG (3,) [m]; unknown space is occupied."""

    def __init__(self, esdf: Esdf, p_WG: np.ndarray, config: ExpertConfig) -> None:
        self._lattice = TrajectoryLattice(config.lattice())
        self.field = esdf if esdf.occupied_outside else esdf.conservative()
        self.toa = time_of_arrival(self.field, p_WG, config.lattice().margin)

    def label(self, time: float, state: np.ndarray) -> Hypotheses:
        """Plans the K best trajectories from a state (13,), cheapest first; may raise as `plan`."""
        return plan(time, state, self.field, self.toa, self._lattice)

    def labels(self, states: Iterable[np.ndarray]) -> list[Label]:
        """Labels the states (13,) from which a path leads to the goal."""
        labels = []
        for state in states:
            with contextlib.suppress(InfeasibleFlightError):
                labels.append(Label(state, self.label(0.0, state)))
        return labels


def fly_policy(
    p_WS: np.ndarray, world: World, config: ExpertConfig, labeler: Labeler
) -> ExpertFlight:
    """Flies the expert's policy from p_WS (3,) [m] to the world's goal, as in the benchmark."""
    policy = policy_named(config.policy, config.speed)
    scenario = Scenario(start=p_WS.tolist(), start_radius=0.0, policy=policy)
    flight = fly(BuildFlightDiagram(scenario, world, camera=False))
    times = np.arange(0.0, flight.times[-1], config.period)
    return ExpertFlight(
        flight.outcome,
        float(flight.times[-1]),
        float(np.nanmin(flight.clearances)),
        labeler.labels(flight.states[np.searchsorted(flight.times, times - 1e-9)]),
    )


def fly_planner(
    p_WS: np.ndarray, world: World, config: ExpertConfig, labeler: Labeler
) -> list[ExpertFlight]:
    """Flies the planner from the starts p_WS (N, 3) [m] to the labeler's goal, all at once, by the
    equations of plant and controller, looking along the path."""
    control, params, p_WG = FlatnessControllerConfig(), QuadrotorParams(), labeler.toa.p_WG
    substeps = ceil(config.period / _STEP - 1e-9)
    dt = config.period / substeps
    yaws = np.arctan2(p_WG[1] - p_WS[:, 1], p_WG[0] - p_WS[:, 0])
    states = np.stack([hover_state(p, yaw) for p, yaw in zip(p_WS, yaws, strict=True)])
    flying = np.arange(len(p_WS))
    outcomes = [Outcome.TIMEOUT] * len(p_WS)
    traces: list[list[np.ndarray]] = [[p] for p in p_WS]
    labels: list[list[Label]] = [[] for _ in p_WS]
    for number in range(ceil(Scenario.timeout / config.period)):
        if not len(flying):
            break
        paths = np.full((len(flying), NUM_WAYPOINTS + 1, 3), np.nan)
        for row, (n, state) in enumerate(zip(flying, states, strict=True)):
            with contextlib.suppress(InfeasibleFlightError):  # No path: the flight does not arrive.
                plan = labeler.label(number * config.period, state)
                labels[n].append(Label(state, plan))
                paths[row] = np.vstack([state[:3], plan.waypoints_W[plan.best]])
        keep = np.isfinite(paths[:, 0, 0])
        flying, paths, states = flying[keep], paths[keep], states[keep]
        for step in range(substeps):
            p_WB, v_WB, _, _ = QuadrotorState.of(states)
            along = (step * dt + control.lookahead) / WAYPOINT_PERIOD
            i = min(int(along), NUM_WAYPOINTS - 1)
            p_WR = paths[:, i] + min(along - i, 1.0) * (paths[:, i + 1] - paths[:, i])
            a_WB = reaching_acceleration(p_WR, p_WB, v_WB, control.lookahead)
            heading = np.arctan2(p_WR[:, 1] - p_WB[:, 1], p_WR[:, 0] - p_WB[:, 0])
            command = flatness_command(states, a_WB, v_WB, heading, control, params)
            states = rk4_step(states, command, params, dt)
            p_WB = QuadrotorState.of(states).p_WB
            for n, p in zip(flying, p_WB, strict=True):
                traces[n].append(p)
            arrived = lengths(p_WB - p_WG)[:, 0] <= Scenario.goal_radius
            collided = labeler.field.distance(p_WB) < VEHICLE_RADIUS
            for ended, outcome in ((arrived, Outcome.GOAL), (collided, Outcome.COLLISION)):
                for n in flying[ended]:
                    outcomes[n] = outcome
            keep = ~(arrived | collided)
            flying, paths, states = flying[keep], paths[keep], states[keep]
    flights = []
    for outcome, trace, labeled in zip(outcomes, traces, labels, strict=True):
        distances = world.distance_field.distance(np.stack(trace))
        clearance = float(np.nanmin(distances)) - VEHICLE_RADIUS
        flights.append(ExpertFlight(outcome, dt * (len(trace) - 1), clearance, labeled))
    return flights
