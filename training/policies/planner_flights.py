"""Flights of the planner through one world to one goal, many at once."""

from math import ceil

import numpy as np
import torch

from splatpilot.diagrams.flight import Outcome
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD, Hypotheses
from splatpilot.systems.vehicle.flatness import reaching_acceleration
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS, hover_state
from splatpilot.training.policies.expert import ExpertConfig, ExpertFlight, Labeller
from splatpilot.training.policies.vehicles import BodyRate

GOAL_RADIUS = 0.3  # [m]
TIMEOUT = 60.0  # [s]

_STEP = 0.02  # [s], at most, between two commands


@torch.no_grad()
def fly_planner(
    p_WS: np.ndarray, world: World, config: ExpertConfig, labeller: Labeller
) -> list[ExpertFlight]:
    """Flies from each of the starts p_WS (N, 3) [m] to the labeller's goal.

    The vehicles are `BodyRate`, which has the equations of the simulated plant and the law of its
    controller; a step of many costs as much as one of one. They look along their way. What they fly
    by are their labels, and plans in between.

    Raises:
        ValueError: if no way leads to the goal from a state along a flight.
    """
    control, p_WG = FlatnessControllerConfig(), labeller.toa.p_WG
    substeps = ceil(config.period / config.plans / _STEP - 1e-9)
    dt = config.period / config.plans / substeps
    yaws = np.arctan2(p_WG[1] - p_WS[:, 1], p_WG[0] - p_WS[:, 0])
    states = np.stack([hover_state(p, yaw) for p, yaw in zip(p_WS, yaws, strict=True)])
    vehicle = BodyRate(torch.from_numpy(states), torch.zeros(len(p_WS), 3, dtype=torch.float64))
    flying = np.arange(len(p_WS))
    traces: list[list[np.ndarray]] = [[state] for state in states]
    labelled: list[list[tuple[np.ndarray, Hypotheses]]] = [[] for _ in states]
    outcomes = [Outcome.TIMEOUT] * len(p_WS)
    for step in range(ceil(TIMEOUT / dt)):
        tick, since = divmod(step, substeps)
        if since == 0:
            states = vehicle.state.numpy().copy()
            plans = [labeller.label(step * dt, state) for state in states]
            if tick % config.plans == 0:
                for n, state, label in zip(flying, states, plans, strict=True):
                    labelled[n].append((state, label))
            ways = np.stack([_best_way(label) for label in plans])  # (n, 11, 3)
        p_WR = torch.from_numpy(_along(ways, since * dt + control.lookahead))
        motion = p_WR - vehicle.p
        a_cmd = reaching_acceleration(p_WR, vehicle.p, vehicle.v, control.lookahead)
        vehicle = vehicle.step(a_cmd, dt, control, torch.atan2(motion[:, 1], motion[:, 0]))
        states = vehicle.state.numpy()
        for n, state in zip(flying, states, strict=True):
            traces[n].append(state)
        arrived = np.linalg.norm(states[:, :3] - p_WG, axis=1) <= GOAL_RADIUS
        touched = labeller.field.distance(states[:, :3]) < VEHICLE_RADIUS
        ended = arrived | touched
        if ended.any():
            for n, hit in zip(flying[ended], touched[ended], strict=True):
                outcomes[n] = Outcome.COLLISION if hit else Outcome.GOAL
            flying, ways, going = flying[~ended], ways[~ended], torch.from_numpy(~ended)
            vehicle = BodyRate(*(x[going] for x in vehicle))
            if not len(flying):
                break
    return [
        ExpertFlight(
            outcome,
            dt * (len(trace) - 1),
            _least_clearance(np.stack(trace)[:, :3], world),
            np.stack([state for state, _ in labels]),
            [label for _, label in labels],
        )
        for outcome, trace, labels in zip(outcomes, traces, labelled, strict=True)
    ]


def _least_clearance(p_WB: np.ndarray, world: World) -> float:
    return float(np.nanmin(world.distance_field.distance(p_WB))) - VEHICLE_RADIUS


def _best_way(plan: Hypotheses) -> np.ndarray:
    """The cheapest trajectory from the pose it was planned at on: (11, 3) [m] in W, each 0.1 s."""
    return np.vstack([plan.X_WB.translation(), plan.waypoints_W[plan.best]])


def _along(ways: np.ndarray, time: float) -> np.ndarray:
    """Points (n, 3) [m] of ways (n, 11, 3) at a time [s] since they began, then their ends."""
    along = min(time / WAYPOINT_PERIOD, NUM_WAYPOINTS - 1e-9)
    i = int(along)
    return ways[:, i] + (along - i) * (ways[:, i + 1] - ways[:, i])
