"""One flight of a study, as worker processes fly it."""

import functools
import hashlib
import io
import itertools
import json
import math
import platform
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Diagram

from splatpilot import _native
from splatpilot.analysis.benchmark.study import RolloutSpec
from splatpilot.diagrams.flight.blocks import goal_position
from splatpilot.diagrams.flight.flight import Flight, Outcome, decision_times, fly
from splatpilot.diagrams.flight.flight_diagram import LOG_PERIOD, BuildFlightDiagram
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import dump_config, parse_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.registry import import_modules
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, path_lengths
from splatpilot.systems.vehicle.state import QuadrotorState

_JERK_STRIDE = 5
"""Samples between differentiated velocities: 0.1 s, beyond the controller's steps of 0.02 s."""


def flight_metrics(flight: Flight, shortest: float) -> dict[str, float | str | bool]:
    """
    Returns the metrics of a flight, by their columns.

    - `success`: reached the goal, with a clearance at the vehicle's radius that is never negative;
    - `outcome`: `goal`, `collision`, `left_volume`, `timeout` or `error`;
    - `flight_time_s`, `path_length_m`, `mean_speed_m_s`, `min_clearance_m`;
    - `shortest_path_m`, `path_excess`: the path over the shortest path, minus one; NaN of flights
      that did not arrive;
    - `jerk_m_s3`: root mean square of the second differences of the velocity at 0.1 s;
    - `smoothness`: the logarithmic dimensionless jerk, -ln(T³ / v_max² ∫ |jerk|² dt) (N. Hogan and
      D. Sternad, J. Motor Behavior 41, 2009); larger is smoother.

    Args:
        flight: of a study.
        shortest: length of the shortest path from start to goal [m].
    """
    summary = flight.summary()
    arrived = flight.outcome == Outcome.GOAL
    clearance = float(np.nanmin(flight.clearances))
    length, duration = float(summary["path_length_m"]), float(summary["flight_time_s"])
    jerk, smoothness = jerk_metrics(QuadrotorState.of(flight.states).v_WB, flight.times)
    return {
        "success": arrived and clearance >= 0.0,
        "outcome": str(flight.outcome),
        "flight_time_s": duration,
        "path_length_m": length,
        "mean_speed_m_s": float(summary["mean_speed_m_s"]),
        "min_clearance_m": clearance,
        "shortest_path_m": shortest,
        "path_excess": length / shortest - 1.0 if arrived and shortest > 0 else math.nan,
        "jerk_m_s3": jerk,
        "smoothness": smoothness,
    }


def jerk_metrics(velocities: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Returns root mean square jerk [m/s^3] and smoothness [-] of velocities (N, 3) [m/s] at times
    (N,) [s], `LOG_PERIOD` apart, see `flight_metrics`; NaN of short flights."""
    sampled = velocities[np.isclose(np.arange(len(times)) * LOG_PERIOD, times)][::_JERK_STRIDE]
    if len(sampled) < 4:
        return math.nan, math.nan
    step = _JERK_STRIDE * LOG_PERIOD
    square = np.square(np.diff(sampled, n=2, axis=0) / step**2).sum(axis=1).mean()
    duration = step * (len(sampled) - 1)
    fastest = np.linalg.norm(sampled, axis=1).max()
    if square == 0.0 or fastest == 0.0:
        return float(np.sqrt(square)), math.nan
    return float(np.sqrt(square)), float(-np.log(duration**4 * square / fastest**2))


def shortest_length(lengths: TimeOfArrival, p_WS: np.ndarray, goal_radius: float) -> float:
    """Returns the length [m] of the shortest path from p_WS (3,) to the goal's sphere; NaN without
    a path.

    Args:
        lengths: of the paths to the goal, `path_lengths`.
        p_WS: start.
        goal_radius: [m].
    """
    if not lengths.is_reachable(p_WS):
        return math.nan
    return max(float(lengths.value(p_WS)) - goal_radius, 0.0)


ARRAYS = "times", "states", "commands", "clearances"
"""The arrays of `Flight` in a study."""

INFEASIBLE = "infeasible"
"""The outcome of a flight that cannot start (`InfeasibleFlightError`), a failure with a reason. One
that becomes infeasible in flight has `Outcome.ERROR`."""


class Rollout(NamedTuple):
    """A flight in a study."""

    row: dict[str, Any]
    """Its specification and metrics, deterministic."""
    trajectory: bytes
    """An .npz with `row` (JSON) and `ARRAYS` in single precision, deterministic."""
    timing: dict[str, Any]
    """Times and machine."""


class Fault(NamedTuple):
    """An exception that is not a failure of its flight."""

    id: str
    """Name of the flight."""
    reason: str
    """The exception in one line."""
    traceback: str


def fly_rollouts(
    flights: list[tuple[RolloutSpec, str]],
    modules: Sequence[str] = (),
    policies: Sequence[str] = (),
) -> list[Rollout | Fault]:
    """Flies flights in this process, up to the first fault.

    Args:
        flights: with their scenarios as YAML; Drake's configurations and some exceptions cannot be
            pickled.
        modules: plugins to import.
        policies: `module:attribute`, not registered by a module.
    """
    import_modules(modules)
    for policy in policies:
        POLICIES.find(policy)
    flown: list[Rollout | Fault] = []
    for spec, text in flights:
        try:
            flown.append(fly_rollout(spec, parse_config(Scenario(), text, f"flight {spec.id}")))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".partition("\n")[0]
            return [*flown, Fault(spec.id, reason, traceback.format_exc())]
    return flown


def fly_rollout(spec: RolloutSpec, scenario: Scenario) -> Rollout:
    """
    Flies one flight of a study.

    Flights fail by their outcome, or if they are or become infeasible. Other exceptions, as of a
    bug or a missing scene, must stop the study, and are raised.

    Args:
        spec: the flight.
        scenario: with the policy and seed of `spec`.
    """
    started, cpu_started = time.perf_counter(), time.process_time()
    timing: dict[str, Any] = {"id": spec.id}
    try:
        world = study_world(scenario)
        timing["world_s"] = time.perf_counter() - started
        diagram = BuildFlightDiagram(scenario, world, camera=False)
        flight = fly(diagram, scenario, world)
        shortest = shortest_length(
            _way_lengths(world, scenario),
            QuadrotorState.of(flight.states[0]).p_WB,
            scenario.goal_radius,
        )
        metrics = flight_metrics(flight, shortest) | {"digest": digest(flight)}
        if flight.reason:  # timing the policy could raise again
            metrics["reason"] = flight.reason
        else:
            timing |= _flight_timing(diagram, scenario, flight)
    except InfeasibleFlightError as error:
        flight = None
        metrics = {"success": False, "outcome": INFEASIBLE, "reason": str(error)}
    timing |= {
        "total_s": time.perf_counter() - started,
        "total_cpu_s": time.process_time() - cpu_started,
        "host": platform.node(),
        "simd": _native.simd_levels()[0],
    }
    row = spec._asdict() | metrics
    return Rollout({"id": spec.id} | row, encode(row, flight), timing)


def encode(row: dict[str, Any], flight: Flight | None) -> bytes:
    """Returns the .npz of a flight; without arrays if it could not be flown."""
    arrays = {"row": np.array(json.dumps(row))}
    if flight is not None:
        arrays |= {name: getattr(flight, name).astype(np.float32) for name in ARRAYS}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def digest(flight: Flight) -> str:
    """Returns a digest, equal for bitwise identical flights."""
    arrays = (np.ascontiguousarray(getattr(flight, name)).tobytes() for name in ARRAYS)
    return hashlib.sha256(b"".join(arrays)).hexdigest()[:16]


def chunks[Payload](
    flights: Iterable[tuple[RolloutSpec, Payload]], size: int
) -> Iterator[list[tuple[RolloutSpec, Payload]]]:
    """Yields chunks of at most `size` neighbors through the same world."""
    for _, neighbors in itertools.groupby(flights, lambda f: (f[0].scenario, f[0].seed)):
        yield from map(list, itertools.batched(neighbors, size))


def _flight_timing(diagram: Diagram, scenario: Scenario, flight: Flight) -> dict[str, float]:
    render, decide = decision_times(diagram, scenario, flight)
    return {
        "flight_wall_s": flight.wall_time,
        "real_time_factor": float(flight.times[-1]) / flight.wall_time,
        "policy_ms": 1e3 * decide,
        "render_ms": 1e3 * render,
    }


def study_world(scenario: Scenario) -> World:
    """Makes the world of a flight; caches the last two of a process."""
    world = scenario.world
    return _world(_Described(f"{type(world)} {dump_config(world)}", world), scenario.seed)


class _Described(NamedTuple):
    """A configuration, compared by its type and YAML."""

    text: str
    config: Any

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Described) and self.text == other.text


@functools.lru_cache(maxsize=2)
def _world(described: _Described, seed: int) -> World:
    return make_world(described.config, seed)


@functools.lru_cache(maxsize=2)
def _lengths_to(world: World, p_WG: tuple[float, ...]) -> TimeOfArrival:
    field = world.esdf if world.esdf.occupied_outside else world.esdf.conservative()
    return path_lengths(field, np.array(p_WG))


def _way_lengths(world: World, scenario: Scenario) -> TimeOfArrival:
    return _lengths_to(world, tuple(goal_position(scenario, world)))
