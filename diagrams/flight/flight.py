"""Simulation of one flight, and its record."""

import enum
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, EventStatus
from pydrake.systems.primitives import VectorLogSink

from splatpilot.diagrams.flight.blocks import goal_position, policy_images, start_position
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.messaging.flight_limits import LEVEL
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.systems.vehicle.state import QuadrotorState


def sample_initial_state(scenario: Scenario, world: World) -> np.ndarray:
    """Samples the initial state (13,): level, at rest, with the heading to the goal.

    By the scenario's seed the position is uniform in the sphere of `start_radius` about the start.

    Raises:
        InfeasibleFlightError: if a vehicle at start or goal would collide or be in unknown space,
            or if the start is at the goal.
    """
    scenario = sample_scenario(scenario)
    p_WG, p_WS = goal_position(scenario, world), start_position(scenario, world)
    _check_free(world, "start", p_WS)
    _check_free(world, "goal", p_WG)
    distance = float(np.linalg.norm(p_WG - p_WS))
    if distance <= scenario.goal_radius:
        raise InfeasibleFlightError(
            f"the distance from start to goal must be > goal_radius, {scenario.goal_radius} m, got "
            f"{distance:.2f} m in {world.name}; set start and goal"
        )

    generator = np.random.default_rng(scenario.seed)
    p_WB = None
    # A neighborhood of the start is free: the search ends.
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
    """Raises InfeasibleFlightError if a vehicle at p_WQ (3,) [m] would collide."""
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
            f"vehicle's radius is {VEHICLE_RADIUS} m; choose a point with more clearance"
        )


_TOUCH = 0.03  # [m] max clearance of a landed vehicle, and
_TOUCHDOWN_SPEED = 0.8  # [m/s] its max speed.


class Outcome(enum.StrEnum):
    """Result of a flight."""

    GOAL = "goal"
    COLLISION = "collision"
    LEFT_VOLUME = "left_volume"
    TIMEOUT = "timeout"
    LANDED = "landed"
    ERROR = "error"


@dataclass(frozen=True, eq=False)
class Flight:
    """Record of a flight; N samples at `LOG_PERIOD` and one at the end."""

    outcome: Outcome
    times: np.ndarray  # (N,) [s]
    states: np.ndarray  # (N, 13): p_WB, v_WB, q_WB, w_WB_B
    commands: np.ndarray  # (N, 4): thrust [m/s^2], body rates [rad/s]
    clearances: np.ndarray  # (N,) [m] from the collision sphere; NaN outside the world
    # (M, size) One row a plan, its time first; see splatpilot.systems.policies.hypotheses; (0, 0)
    # without plans.
    hypotheses: np.ndarray
    wall_time: float  # [s] that the simulation took after its initialization
    reason: str = ""  # of the outcome `ERROR`: when and where which exception was raised

    def summary(self) -> dict[str, float | str]:
        """Returns metrics; mean speed is the path length, along the samples, over time."""
        p_WB = QuadrotorState.of(self.states).p_WB
        path_length = float(np.linalg.norm(np.diff(p_WB, axis=0), axis=1).sum())
        duration = float(self.times[-1])
        return {
            "outcome": str(self.outcome),
            "flight_time_s": duration,
            "path_length_m": path_length,
            "mean_speed_m_s": path_length / duration if duration > 0 else 0.0,
            "min_clearance_m": float(np.nanmin(self.clearances)),
            "real_time_factor": duration / self.wall_time,
        } | ({"reason": self.reason} if self.reason else {})

    def save(self, path: Path) -> None:
        """Writes the arrays to a compressed .npz file, deterministically."""
        names = ("times", "states", "commands", "clearances", "hypotheses")
        np.savez_compressed(path, **{name: getattr(self, name) for name in names})


class FlightError(ValueError):
    """An exception of a system; `flight` is the record until then."""

    def __init__(self, flight: Flight) -> None:
        super().__init__(f"the flight ended {flight.reason}")
        self.flight = flight


def fly(
    diagram: Diagram,
    scenario: Scenario,
    world: World,
    progress: Callable[[float], object] | None = None,
    realtime_rate: float = 0.0,
) -> Flight:
    """Simulates a diagram made by `BuildFlightDiagram` until the flight ends.

    Args:
        progress: called with the simulated time [s].
        realtime_rate: max simulated over real time; 0 for as fast as possible.

    Returns:
        The flight. Its outcome is `ERROR` if a system raised `InfeasibleFlightError` after time 0.

    Raises:
        FlightError: from any other exception after time 0.
    """
    scenario = sample_scenario(scenario)
    simulator = flight_simulator(diagram, scenario, world, progress)
    simulator.set_target_realtime_rate(realtime_rate)
    root = simulator.get_mutable_context()
    plant_context = diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    plant_context.SetContinuousState(sample_initial_state(scenario, world))
    simulator.Initialize()
    started = time.perf_counter()
    try:
        simulator.AdvanceTo(scenario.timeout)
    except Exception as error:
        if root.get_time() == 0.0 or isinstance(error, MemoryError):
            raise
        wall_time = time.perf_counter() - started
        flight = record_flight(diagram, root, world, Outcome.ERROR, wall_time)
        flight = replace(flight, reason=_reason(error, root.get_time(), flight.states[-1]))
        if isinstance(error, InfeasibleFlightError):
            return flight
        raise FlightError(flight) from error
    wall_time = time.perf_counter() - started

    p_WG = goal_position(scenario, world)
    ended = flight_outcome(diagram, root, p_WG, scenario.goal_radius) or Outcome.TIMEOUT
    return record_flight(diagram, root, world, ended, wall_time)


def flight_simulator(
    diagram: Diagram,
    scenario: Scenario,
    world: World,
    progress: Callable[[float], object] | None = None,
) -> Simulator:
    """Makes a simulator of a diagram made by `BuildFlightDiagram` that ends with the flight."""
    scenario = sample_scenario(scenario)
    scenario.validate()
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)
    p_WG = goal_position(scenario, world)

    def monitor(context: Context) -> EventStatus:
        if progress is not None:
            progress(context.get_time())
        outcome = flight_outcome(diagram, context, p_WG, scenario.goal_radius)
        if outcome is None:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(diagram, outcome)

    simulator.set_monitor(monitor)
    return simulator


def decision_times(
    diagram: Diagram, scenario: Scenario, flight: Flight, count: int = 10
) -> tuple[float, float]:
    """Measures mean wall times [s] of rendering for the policy, and of its update without that.

    They are averaged over `count` states evenly spaced along a flight.
    """
    root = Simulator(diagram).get_mutable_context()
    plant = diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    policy = diagram.GetSubsystemByName("policy")
    context = policy.GetMyContextFromRoot(root)
    images = policy_images(policy)
    rows = np.linspace(0, len(flight.states) - 1, count).astype(int)
    spent = np.zeros((count + 1, 2))  # [s]
    # The first time fills caches, and does not count.
    for k, row in enumerate([0, *rows]):
        root.SetTime(flight.times[row])
        plant.SetContinuousState(flight.states[row])
        started = time.perf_counter()
        for name in images:
            policy.GetInputPort(name).Eval(context)
        rendered = time.perf_counter()
        if policy.GetUniquePeriodicDiscreteUpdateAttribute() is not None:
            policy.EvalUniquePeriodicDiscreteUpdate(context)
        for index in range(policy.num_output_ports()):
            policy.get_output_port(index).Eval(context)
        spent[k] = rendered - started, time.perf_counter() - rendered
    render, decide = spent[1:].mean(axis=0)
    return float(render), float(decide)


def flight_outcome(
    diagram: Diagram, context: Context, p_WG: np.ndarray, goal_radius: float
) -> Outcome | None:
    """Returns the outcome at this instant; None during the flight."""
    if vector_output(diagram, "in_collision", context)[0]:
        return Outcome.COLLISION
    if vector_output(diagram, "field_state", context)[0] >= FieldState.UNKNOWN:
        return Outcome.LEFT_VOLUME
    p_WB = QuadrotorState.of(vector_output(diagram, "state", context)).p_WB
    if np.linalg.norm(p_WG - p_WB) <= goal_radius:
        return Outcome.GOAL
    return None


def has_landed(diagram: Diagram, context: Context) -> bool:
    """Checks if the vehicle touches a level surface, slowly."""
    v_WB = QuadrotorState.of(vector_output(diagram, "state", context)).v_WB
    return bool(
        vector_output(diagram, "clearance", context)[0] < _TOUCH
        and vector_output(diagram, "gradient", context)[2] > LEVEL
        and np.linalg.norm(v_WB) < _TOUCHDOWN_SPEED
    )


def record_flight(
    diagram: Diagram, root: Context, world: World, outcome: Outcome, wall_time: float
) -> Flight:
    """Collects the logs of a flight; after an error no port is evaluated, as it may raise again."""
    logs = {
        name: cast(VectorLogSink, diagram.GetSubsystemByName(f"{name}_log")).FindLog(root)
        for name in ("state", "command")
    }
    times = logs["state"].sample_times().copy()
    # Copies, since logs return views of memory of the diagram.
    states, commands = (log.data().T.copy() for log in logs.values())
    if root.get_time() > times[-1] and outcome is not Outcome.ERROR:
        times = np.append(times, root.get_time())
        states = np.vstack([states, vector_output(diagram, "state", root)])
        commands = np.vstack([commands, vector_output(diagram, "command", root)])
    return Flight(
        outcome=outcome,
        times=times,
        states=states,
        commands=commands,
        clearances=world.distances(times, QuadrotorState.of(states).p_WB) - VEHICLE_RADIUS,
        hypotheses=_recorded_plans(diagram, root, outcome is not Outcome.ERROR),
        wall_time=wall_time,
    )


def _recorded_plans(diagram: Diagram, root: Context, with_last: bool) -> np.ndarray:
    """Returns all plans (M, size), or (0, 0) without any."""
    if not diagram.HasOutputPort("hypotheses"):
        return np.empty((0, 0))
    sink = cast(VectorLogSink, diagram.GetSubsystemByName("hypotheses_log"))
    plans = sink.FindLog(root).data().T.copy()
    # A log samples before the policy updates at the same instant: the last plan is missing.
    if with_last:
        last = vector_output(diagram, "hypotheses", root)
        if last[0] != plans[-1, 0]:
            plans = np.vstack([plans, last])
    return plans[np.isfinite(plans[:, 0])]


def _reason(error: Exception, time: float, state: np.ndarray) -> str:
    """Describes an exception with its time and state (13,)."""
    p_WB, v_WB, _, _ = (part.round(2).tolist() for part in QuadrotorState.of(state))
    kind = "" if isinstance(error, InfeasibleFlightError) else f"{type(error).__name__}: "
    return f"at t = {time:.2f} s, p_WB = {p_WB} m, v_WB = {v_WB} m/s: {kind}{error}"


FLIGHT_FILES = "trajectory.npz", "scenario.yaml", "summary.json"


def write_flight(out: Path, scenario: Scenario, flight: Flight) -> None:
    """Writes the arrays of `Flight` to `trajectory.npz`, and `scenario.yaml`, into `out`."""
    with written_atomically(out / "trajectory.npz") as path:
        flight.save(path)
    with written_atomically(out / "scenario.yaml") as path:
        path.write_text(dump_config(scenario))


def write_summary(out: Path, summary: dict[str, float | str]) -> None:
    """Writes `summary.json` into the folder `out`."""
    with written_atomically(out / "summary.json") as path:
        path.write_text(json.dumps(summary, indent=2) + "\n")
