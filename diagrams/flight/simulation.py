"""Simulation of flights, their records, and random flights for Drake's Monte Carlo tools."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, EventStatus, System
from pydrake.systems.primitives import VectorLogSink

from splatpilot.diagrams.flight.blocks import policy_images
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import FlightMonitor, Outcome, flight_monitors
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    sample_scenario,
)
from splatpilot.diagrams.worlds.observed_routes import ObservedViews
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.files import write_text, written_atomically
from splatpilot.systems.common.provenance import MONTE_CARLO_SEEDS, InfeasibleFlightError
from splatpilot.systems.common.validation import require
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state, set_state
from splatpilot.systems.visualization.live import RESTART

_ACCURACY = 3e-4  # of the Context: a flight ends within 1e-7 s, less than a micrometer.
_CLOSE = 2e-8  # [s] to the end; twice that needs no isolation at this accuracy


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
    # Mean fraction of the policy's view without an observed surface; NaN if it is not known.
    unobserved: float = math.nan
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
            **({} if math.isnan(self.unobserved) else {"unobserved_fraction": self.unobserved}),
            **({"reason": self.reason} if self.reason else {}),
        }

    def __repr__(self) -> str:
        return (
            f"Flight({self.outcome} after {self.times[-1]:.2f} s, "
            f"min. clearance {np.nanmin(self.clearances):+z.2f} m)"
        )

    def _repr_html_(self) -> str:
        texts = {
            name: value if isinstance(value, str) else f"{value:.3f}"
            for name, value in self.summary().items()
        }
        rows = (f"<tr><td>{name}</td><td>{escape(text)}</td></tr>" for name, text in texts.items())
        return f"<table>{''.join(rows)}</table>"

    def save(self, path: Path) -> None:
        """Writes the arrays to a compressed .npz file, deterministically."""
        names = ("times", "states", "commands", "clearances", "hypotheses")
        np.savez_compressed(path, **{name: getattr(self, name) for name in names})


class FlightError(ValueError):
    """An exception of a system; `flight` is the record until then."""

    def __init__(self, flight: Flight) -> None:
        super().__init__(f"the flight ended {flight.reason}")
        self.flight = flight


def make_flight_simulator(diagram: Diagram, generator: RandomGenerator | None = None) -> Simulator:
    """Makes a simulator of a diagram with a `FlightMonitor`, as its scenario says; of several, as
    that with the smallest step.

    The Context is that of SetRandomContext with the generator, by default of the scenario's seed,
    so that Drake's random sources repeat. All else that is random follows from the scenario's seed
    when the diagram is built, see `random_flights`. The Context's accuracy lets the flight end at
    the exact instant.
    """
    scenarios = [system.scenario for _, system in _require_monitors(diagram)]
    scenario, simulator = scenarios[0], Simulator(diagram)
    finest = min((each.simulator for each in scenarios), key=lambda each: each.max_step_size)
    ApplySimulatorConfig(finest, simulator)
    root = simulator.get_mutable_context()
    diagram.SetRandomContext(root, generator or RandomGenerator(scenario.seed))
    root.SetAccuracy(_ACCURACY)
    return simulator


def fly(
    diagram: Diagram,
    *,
    monitor: Callable[[Context], EventStatus | None] | None = None,
    progress: Callable[[float], object] | None = None,
    realtime_rate: float = 0.0,
) -> Flight:
    """Simulates a diagram with one `FlightMonitor` until the flight ends.

    Args:
        monitor: called with the root Context after each step, such as `LiveControls`; may end the
            flight by ReachedTermination. With the message `RESTART` it begins again.
        progress: called with the simulated time [s].
        realtime_rate: max simulated over real time; 0 for as fast as possible.

    Returns:
        The flight. Its outcome is `ERROR` if a system raised `InfeasibleFlightError` after time 0.

    Raises:
        FlightError: from any other exception after time 0.
        KeyboardInterrupt: after Ctrl-C, whose `flight` is the record until then.
    """
    count = len(_require_monitors(diagram))
    require(count == 1, "the number of flights in the diagram", "1", count, "call fly_all")
    (flight,) = fly_all(
        diagram, monitor=monitor, progress=progress, realtime_rate=realtime_rate
    ).values()
    return flight


def fly_all(
    diagram: Diagram,
    *,
    monitor: Callable[[Context], EventStatus | None] | None = None,
    progress: Callable[[float], object] | None = None,
    realtime_rate: float = 0.0,
) -> dict[str, Flight]:
    """Simulates all flights of a diagram until each has ended, by the name of its monitor.

    A vehicle whose flight has ended flies on until the last one has. Exceptions are those of `fly`
    and hold the first flight that had not ended.
    """
    while True:
        flights = _fly_once(diagram, monitor, progress, realtime_rate)
        if flights is not None:
            return flights


def _fly_once(
    diagram: Diagram,
    monitor: Callable[[Context], EventStatus | None] | None,
    progress: Callable[[float], object] | None,
    realtime_rate: float,
) -> dict[str, Flight] | None:
    """Simulates all flights of a diagram, see `fly_all`; returns None to begin again."""
    found = _require_monitors(diagram)
    systems = [system for _, system in found]
    names = [system.get_name() for system in systems]
    monitors = dict(zip(names, found, strict=True))
    require(len(monitors) == len(names), "names of FlightMonitors", "different", names)
    simulator = make_flight_simulator(diagram)
    simulator.set_target_realtime_rate(realtime_rate)
    root = simulator.get_mutable_context()
    for system in systems:
        system.overrun = None

    def watch(context: Context) -> EventStatus:
        if progress is not None:
            progress(context.get_time())
        status = (monitor and monitor(context)) or EventStatus.DidNothing()
        for system in systems:
            if system.overrun is not None and system.overrun[0] > context.get_time():
                if status.severity() in _SEVERITIES_IN_FLIGHT:
                    return EventStatus.ReachedTermination(system, _NEAR_END)
        return status

    simulator.set_monitor(watch)
    limit = max(system.scenario.timeout for system in systems)
    flights: dict[str, Flight] = {}

    def record(outcome: Outcome | None = None) -> None:
        """Records the flights that have ended; with an outcome, all others too."""
        for name, (parent, system) in monitors.items():
            if name not in flights:
                ended = outcome or system.outcome(system.GetMyContextFromRoot(root))
                if ended is not None:
                    wall_time = time.perf_counter() - started
                    prefix = name.removesuffix("monitor")
                    flight = record_flight(parent, root, ended, wall_time, prefix)
                    fraction = unobserved_fraction(system.scenario, system.world, flight.states)
                    flights[name] = replace(flight, unobserved=fraction)

    simulator.Initialize()
    started = time.perf_counter()
    try:
        record()
        for name, flight in flights.items():
            at_goal, condition = flight.outcome is Outcome.GOAL, "in flight at its start"
            require(at_goal, name, condition, flight.outcome, _START)
        while len(flights) < len(monitors):
            end = min(_next_time(system, root) for system in systems)
            status = simulator.AdvanceTo(min(end, limit))
            record()
            if status.message() == RESTART:
                return None
            near = end < limit and status.reason() == _BOUNDARY
            if not near and not isinstance(status.system(), FlightMonitor):
                break
        record(Outcome.INTERRUPTED)
    except KeyboardInterrupt as error:
        record(Outcome.INTERRUPTED)
        vars(error)["flight"] = _first(flights, Outcome.INTERRUPTED)
        raise
    except Exception as error:
        if root.get_time() == 0.0 or isinstance(error, MemoryError):
            raise
        record(Outcome.ERROR)
        for name, flight in flights.items():
            if flight.outcome is Outcome.ERROR:
                reason = _reason(error, root.get_time(), flight.states[-1])
                flights[name] = replace(flight, reason=reason)
        if not isinstance(error, InfeasibleFlightError):
            raise FlightError(_first(flights, Outcome.ERROR)) from error
    return flights


_NEAR_END = "near the end"
_BOUNDARY = SimulatorStatus.ReturnReason.kReachedBoundaryTime
_SEVERITIES_IN_FLIGHT = EventStatus.Severity.kDidNothing, EventStatus.Severity.kSucceeded


def _next_time(monitor: FlightMonitor, root: Context) -> float:
    """Returns a time [s] close to the end of a flight that a step of its simulator has passed.

    Drake isolates such an end by halving the step, and begins again with a full one after each that
    stops before the end. The secant, first to just before the end, takes a tenth of those steps.
    """
    (end, beyond), now = monitor.overrun or (0.0, 0.0), root.get_time()
    if end <= now:
        monitor.overrun = None
        return math.inf
    margin = monitor.margin(monitor.GetMyContextFromRoot(root))
    duration = margin / (margin - beyond) * (end - now)
    return min(now + duration + (-_CLOSE if duration > 2 * _CLOSE else _CLOSE), end)


_MAX_VIEWS = 60  # of a flight


def unobserved_fraction(scenario: Scenario, world: World, states: np.ndarray) -> float:
    """Returns the mean fraction of `ObservedViews` along states (N, 13), for the camera of the
    scenario's policy; NaN for a world that is not captured, or of an older scene."""
    if world.observations is None and not world.num_frontier:
        return math.nan
    camera = getattr(scenario.policy, "camera", None) or OnboardCamera()
    views = ObservedViews(world, camera)
    rows = np.linspace(0, len(states) - 1, min(_MAX_VIEWS, len(states))).astype(int)
    return float(np.mean([views.unobserved(pose_from_state(state)) for state in states[rows]]))


_START = "build the plant with sample_initial_state(scenario, world)"


def _first(flights: dict[str, Flight], outcome: Outcome) -> Flight:
    return next(flight for flight in flights.values() if flight.outcome is outcome)


def _require_monitors(diagram: Diagram) -> list[tuple[Diagram, FlightMonitor]]:
    monitors = flight_monitors(diagram)
    if not monitors:
        raise ValueError(
            "the diagram must have a FlightMonitor to be flown; add one by AddFlightMonitor"
        )
    return monitors


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
        set_state(plant, flight.states[row])
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


def record_flight(
    diagram: Diagram, root: Context, outcome: Outcome, wall_time: float, prefix: str = ""
) -> Flight:
    """Collects the logs of a flight, see `AddLogs`, whose names in its diagram have a prefix.

    After an error no port is evaluated, as it may raise again.
    """
    is_complete = outcome is not Outcome.ERROR

    def samples(name: str, again: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Returns times and rows of a log with those of this instant, if later or `again`."""
        sink = cast(VectorLogSink, diagram.GetSubsystemByName(f"{prefix}{name}_log"))
        log = sink.FindLog(root)
        # Copies, since logs return views of memory of the diagram.
        times, rows = log.sample_times().copy(), log.data().T.copy()
        if is_complete and (again or root.get_time() > times[-1]):
            # Ports of Drake's own systems, once in Python, keep their diagram alive.
            last = sink.EvalVectorInput(sink.GetMyContextFromRoot(root), 0).CopyToVector()
            times, rows = np.append(times, root.get_time()), np.vstack([rows, last])
        return times, rows

    times, states = samples("state")
    commands, clearances = samples("command")[1], samples("clearance")[1]
    plans = np.empty((0, 0))
    if diagram.HasSubsystemNamed(f"{prefix}hypotheses_log"):
        # A log samples before the policy updates at the same instant: the last plan is missing.
        _, plans = samples("hypotheses", again=True)
        is_new = np.diff(plans[:, 0], prepend=np.nan) != 0
        plans = plans[is_new & np.isfinite(plans[:, 0])]
    count = min(map(len, (states, commands, clearances)))  # An error may leave the last ones out.
    return Flight(
        outcome=outcome,
        times=times[:count],
        states=states[:count],
        commands=commands[:count],
        clearances=clearances[:count, 0],
        hypotheses=plans,
        wall_time=wall_time,
    )


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
    write_text(out / "scenario.yaml", dump_config(scenario))


def write_summary(out: Path, summary: dict[str, float | str]) -> None:
    """Writes `summary.json` into the folder `out`."""
    write_text(out / "summary.json", json.dumps(summary, indent=2) + "\n")


def random_flights(
    scenario: Scenario,
    world: World | None = None,
    *,
    build: Callable[[Scenario, World], Diagram] | None = None,
    **systems: str | Callable[[Scenario, World], System],
) -> Callable[[RandomGenerator], Simulator]:
    """Makes simulators of flights with random seeds: starts, noise, latency and worlds differ.

        def clearance(diagram, context):
            return diagram.GetOutputPort("clearance").Eval(context)[0]

        MonteCarloSimulation(random_flights(scenario), clearance, scenario.timeout, 20)

    Seeds are of `MONTE_CARLO_SEEDS`. The Context is the start of the flight, and a simulation ends
    with it, see `FlightMonitor`.

    Args:
        scenario: of the flights; each replaces its seed.
        world: of all flights; by default made of each seed, which is slow.
        build: builds the diagram of each flight, instead of `BuildFlightDiagram` without camera.
        systems: arguments of `BuildFlightDiagram` such as `policy="velocity"`; functions of
            scenario and world make a system for each flight.

    Returns:
        The `make_simulator` of these functions, which raises `InfeasibleFlightError` for a world
        without clearance at its start or goal.
    """
    require(build is None or not systems, "build", "without other systems", ", ".join(systems))

    def make_simulator(generator: RandomGenerator) -> Simulator:
        seed = MONTE_CARLO_SEEDS[generator() % len(MONTE_CARLO_SEEDS)]
        sample = sample_scenario(replace(scenario, seed=seed))
        flown = world or make_world(sample.world, sample.seed)
        if build is not None:
            return make_flight_simulator(build(sample, flown))
        made: dict[str, Any] = {
            name: system if isinstance(system, str) else system(sample, flown)
            for name, system in systems.items()
        }
        return make_flight_simulator(BuildFlightDiagram(sample, flown, camera=False, **made))

    return make_simulator
