"""Where a flight starts."""

import numpy as np

from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS, hover_state


def sample_initial_state(scenario: Scenario, world: World) -> np.ndarray:
    """
    The state (13,) a flight starts in: level, at rest, facing the goal.

    The position is drawn from the scenario's seed, uniformly from the ball of `start_radius` about
    the start.

    Raises:
        InfeasibleFlightError: if the start or the goal is outside known space, or nearer to a
            surface than the vehicle's radius; or if the flight would start at its goal.
    """
    p_WG = goal_of(scenario, world)
    p_WS = np.asarray(world.p_WS if scenario.start is None else scenario.start, dtype=float)
    _check_free(world, "start", p_WS)
    _check_free(world, "goal", p_WG)
    apart = float(np.linalg.norm(p_WG - p_WS))
    if apart <= scenario.goal_radius:
        raise InfeasibleFlightError(
            f"{world.name} cannot be flown: start and goal are {apart:.2f} m apart, no farther "
            f"than goal_radius, {scenario.goal_radius} m; name others with start and goal"
        )

    generator = np.random.default_rng(scenario.seed)
    p_WB = None
    # The start itself is free, and so is a neighbourhood of it: the search ends.
    while p_WB is None or not _is_free(world, p_WB):
        direction = generator.normal(size=3)
        distance = scenario.start_radius * generator.uniform() ** (1 / 3)
        p_WB = p_WS + distance * direction / np.linalg.norm(direction)
    heading = p_WG - p_WB
    return hover_state(p_WB, yaw=np.arctan2(heading[1], heading[0]))


def _is_free(world: World, p_WQ: np.ndarray) -> bool:
    sample = world.field_at(0.0).query(p_WQ)
    return bool(sample.state == FieldState.FREE and sample.distance > VEHICLE_RADIUS)


def _check_free(world: World, what: str, p_WQ: np.ndarray) -> None:
    """Raises InfeasibleFlightError unless the vehicle fits at p_WQ (3,) [m]."""
    field = world.field_at(0.0)
    sample = field.query(p_WQ)
    where = f"{what} {np.round(p_WQ, 3).tolist()}"
    if sample.state >= FieldState.UNKNOWN:
        known = "outside the world" if sample.state == FieldState.OUTSIDE else "in unseen space"
        raise InfeasibleFlightError(
            f"{where} is {known}, which spans {np.round(field.lower_W, 2).tolist()} to "
            f"{np.round(field.upper_W, 2).tolist()} m; choose a point in known free space"
        )
    if sample.distance <= VEHICLE_RADIUS:
        raise InfeasibleFlightError(
            f"{where} is {float(sample.distance):.3f} m from the nearest surface, but the "
            f"vehicle's radius is {VEHICLE_RADIUS} m; choose a point with more room"
        )
