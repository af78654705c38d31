"""Flights of the planner through one world to one goal, many at once."""

from math import ceil

import numpy as np

from splatpilot.diagrams.flight import Outcome
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.systems.vehicle.flatness import reaching_acceleration
from splatpilot.systems.vehicle.flatness_batch import flatness_commands, lengths
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import (
    VEHICLE_RADIUS,
    QuadrotorParams,
    hover_state,
    rk4_step,
)
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.training.policies.expert import ExpertConfig, ExpertFlight, Label, Labeller

GOAL_RADIUS = 0.3  # [m]
TIMEOUT = 60.0  # [s]

_STEP = 0.02  # [s], at most, between two commands


def fly_planner(
    p_WS: np.ndarray, world: World, config: ExpertConfig, labeller: Labeller
) -> list[ExpertFlight]:
    """Flies from each of the starts p_WS (N, 3) [m] to the labeller's goal.

    The vehicles have the equations of the simulated plant and the law of its controller; a step of
    many costs as much as one of one. They look along their way, and fly by their labels: a plan
    every 0.4 s leads to the goal as safely as one every 0.07 s.

    Raises:
        ValueError: if no way leads to the goal from a state along a flight.
    """
    control, params, p_WG = FlatnessControllerConfig(), QuadrotorParams(), labeller.toa.p_WG
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
            plan = labeller.label(number * config.period, state)
            labels[n].append(Label(state, plan))
            ways[row] = np.vstack([state[:3], plan.waypoints_W[plan.best]])
        for step in range(substeps):
            p_WB, v_WB, _, _ = QuadrotorState.of(states)
            p_WR = _along(ways, step * dt + control.lookahead)
            a_WB = reaching_acceleration(p_WR, p_WB, v_WB, control.lookahead)
            heading = np.arctan2(p_WR[:, 1] - p_WB[:, 1], p_WR[:, 0] - p_WB[:, 0])
            command = flatness_commands(states, a_WB, control, params, heading)
            states = rk4_step(states, command, params, dt)
            p_WB = QuadrotorState.of(states).p_WB
            for n, p in zip(flying, p_WB, strict=True):
                traces[n].append(p)
            arrived = lengths(p_WB - p_WG)[:, 0] <= GOAL_RADIUS
            touched = labeller.field.distance(p_WB) < VEHICLE_RADIUS
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
