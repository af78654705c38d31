"""One flight of a study, as worker processes fly it."""

import contextlib
import functools
import hashlib
import io
import json
import math
import platform
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import numpy as np

from splatpilot import _native
from splatpilot.analysis.benchmark.study import MakeSystem, RolloutSpec
from splatpilot.analysis.benchmark.variants import ScenarioVariant
from splatpilot.analysis.difficulty import Difficulty, world_difficulty
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.monitor import LOG_PERIOD, Outcome
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_scenario,
    start_position,
)
from splatpilot.diagrams.flight.simulation import Flight, decision_times, fly
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import dump_config, is_configuration, parse_config
from splatpilot.systems.common.distributions import find_distributions
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.registry import import_modules
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, path_lengths
from splatpilot.systems.vehicle.state import QuadrotorState

ARRAYS = "times", "states", "commands", "clearances"
"""The arrays of `Flight` in a study."""

INFEASIBLE = "infeasible"
"""The outcome of a flight that cannot start (`InfeasibleFlightError`), a failure with a reason. One
that becomes infeasible in flight has `Outcome.ERROR`."""

_JERK_STRIDE = 5  # samples between differentiated velocities: beyond the controller's steps
_MAX_WORLDS = 2  # in the cache of a process


class Rollout(NamedTuple):
    """A flight in a study."""

    row: dict[str, Any]  # specification and metrics, deterministic
    trajectory: bytes
    """An .npz with `row` (JSON) and `ARRAYS` in single precision, deterministic."""
    timing: dict[str, Any]  # times and machine


class Fault(NamedTuple):
    """An exception that is not a failure of its flight."""

    id: str  # of the flight
    reason: str  # the exception in one line
    traceback: str


def flight_metrics(flight: Flight, shortest: float) -> dict[str, float | str | bool]:
    """Computes the metrics of a flight, by their columns; `shortest` is the shortest path [m].

    A success reaches the goal with a clearance that is never negative. `path_excess` is the path
    over the shortest one, minus one; NaN if it did not arrive. `jerk_m_s3` is the root mean square
    of the second differences of the velocity at 0.1 s, `smoothness` the logarithmic dimensionless
    jerk, -ln(T³ / v_max² ∫ |jerk|² dt) (N. Hogan and D. Sternad, J. Motor Behavior 41, 2009).
    """
    summary = flight.summary()
    arrived = flight.outcome == Outcome.GOAL
    clearance = float(np.nanmin(flight.clearances))
    length = float(summary["path_length_m"])
    jerk, smoothness = jerk_metrics(QuadrotorState.of(flight.states).v_WB, flight.times)
    end = QuadrotorState.of(flight.states[-1]).p_WB
    return {
        "success": arrived and clearance >= 0.0,
        "outcome": str(flight.outcome),
        "flight_time_s": float(summary["flight_time_s"]),
        "path_length_m": length,
        "mean_speed_m_s": float(summary["mean_speed_m_s"]),
        "min_clearance_m": clearance,
        **{f"end_{axis}_m": x for axis, x in zip("xyz", end.tolist(), strict=True)},
        "shortest_path_m": shortest,
        "unobserved_fraction": flight.unobserved,
        "path_excess": length / shortest - 1.0 if arrived and shortest > 0 else math.nan,
        "jerk_m_s3": jerk,
        "smoothness": smoothness,
    }


def jerk_metrics(velocities: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Computes root mean square jerk [m/s^3] and smoothness [-] of velocities (N, 3) [m/s] at times
    (N,) [s], `LOG_PERIOD` apart, see `flight_metrics`; NaN of short flights."""
    sampled = velocities[np.isclose(np.arange(len(times)) * LOG_PERIOD, times)][::_JERK_STRIDE]
    if len(sampled) < 4:
        return math.nan, math.nan
    step = _JERK_STRIDE * LOG_PERIOD
    square = np.square(np.diff(sampled, n=2, axis=0) / step**2).sum(axis=1).mean()
    duration = step * (len(sampled) - 1)
    fastest = np.linalg.norm(sampled, axis=1).max()
    smoothness = -np.log(duration**4 * square / fastest**2) if square and fastest else math.nan
    return float(np.sqrt(square)), float(smoothness)


def shortest_length(lengths: TimeOfArrival, p_WS: np.ndarray, goal_radius: float) -> float:
    """Returns the length [m] of the shortest path from p_WS (3,) [m] to the goal's sphere of
    `goal_radius` [m], by `path_lengths` to the goal; NaN without a path."""
    if not lengths.is_reachable(p_WS):
        return math.nan
    return max(float(lengths.value(p_WS)) - goal_radius, 0.0)


def fly_rollouts(
    flights: list[tuple[RolloutSpec, str]],
    modules: Sequence[str],
    policies: Sequence[str],
    changed: Mapping[str, ScenarioVariant],
    systems: Mapping[str, MakeSystem],
) -> list[Rollout | Fault]:
    """Flies flights, with their scenarios as YAML, up to the first fault.

    Args:
        modules: plugins to import.
        policies: MODULE:ATTRIBUTE of policies that none of them registers.
        changed: scenarios by label, whose changed fields are columns of the rows.
        systems: functions by label of policies that make the policy's system.
    """
    import_modules(modules)
    for policy in policies:
        POLICIES.find(policy)
    flown: list[Rollout | Fault] = []
    for spec, text in flights:
        try:
            scenario = parse_config(Scenario(), text, f"flight {spec.id}")
            base = changed.get(spec.scenario, ScenarioVariant(spec.scenario, spec.scenario))
            flown.append(_fly_rollout(spec, scenario, base, systems.get(spec.policy)))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".partition("\n")[0]
            return [*flown, Fault(spec.id, reason, traceback.format_exc())]
    return flown


def _fly_rollout(
    spec: RolloutSpec, scenario: Scenario, base: ScenarioVariant, make: MakeSystem | None
) -> Rollout:
    """Flies one flight. Exceptions other than `InfeasibleFlightError` stop the study."""
    names = [*base.fields, *(drawn.name for drawn in find_distributions(scenario))]
    scenario = sample_scenario(scenario)
    values = {name: _field_value(scenario, name) for name in names}
    started, cpu_started = time.perf_counter(), time.process_time()
    timing: dict[str, Any] = {"id": spec.id}
    arrays = {}
    try:
        world = study_world(scenario)
        timing["world_s"] = time.perf_counter() - started
        policy = None if make is None else make(scenario, world)
        diagram = BuildFlightDiagram(scenario, world, camera=False, policy=policy)
        flight = fly(diagram)
        ends = tuple(start_position(scenario, world)), tuple(goal_position(scenario, world))
        shortest = math.nan
        with contextlib.suppress(InfeasibleFlightError):  # for larger vehicles than this one
            p_WS = QuadrotorState.of(flight.states[0]).p_WB
            shortest = shortest_length(_lengths_to(world, ends[1]), p_WS, scenario.goal_radius)
        metrics = flight_metrics(flight, shortest) | {"digest": digest(flight)}
        metrics |= _difficulty(world, *ends, scenario.seed)
        if flight.reason:  # timing the policy could raise again
            metrics["reason"] = flight.reason
        else:
            render, decide = decision_times(diagram, scenario, flight)
            timing |= {
                "flight_wall_s": flight.wall_time,
                "real_time_factor": float(flight.times[-1]) / flight.wall_time,
                "policy_ms": 1e3 * decide,
                "render_ms": 1e3 * render,
            }
        arrays = {name: getattr(flight, name).astype(np.float32) for name in ARRAYS}
    except InfeasibleFlightError as error:
        metrics = {"success": False, "outcome": INFEASIBLE, "reason": str(error)}
    timing |= {
        "total_s": time.perf_counter() - started,
        "total_cpu_s": time.process_time() - cpu_started,
        "host": platform.node(),
        "simd": _native.simd_levels()[0],
    }
    row = spec._asdict() | {"world_id": _world_name(base, spec.seed, values)} | values | metrics
    file = io.BytesIO()
    np.savez_compressed(file, row=np.array(json.dumps(row)), **arrays)
    return Rollout({"id": spec.id} | row, file.getvalue(), timing)


def _field_value(scenario: Scenario, name: str) -> Any:
    """Returns the value of a field, by its dotted name, as JSON holds it."""
    value: Any = scenario
    for part in name.split("."):
        if isinstance(value, list):
            value = value[int(part)]
        else:
            value = value[part] if isinstance(value, dict) else getattr(value, part)
    if is_configuration(value):
        return dump_config(value)
    return value.tolist() if isinstance(value, np.ndarray) else value


def _world_name(base: ScenarioVariant, seed: int, values: dict[str, Any]) -> str:
    """Names the world of a flight: flights of the same name share it."""
    changed = {name: value for name, value in values.items() if name.startswith("world")}
    text = json.dumps(changed, sort_keys=True)
    suffix = f"-{hashlib.sha256(text.encode()).hexdigest()[:8]}" if changed else ""
    return f"{base.base}-{seed:03d}{suffix}"


def digest(flight: Flight) -> str:
    """Returns a digest, equal for bitwise identical flights."""
    arrays = (np.ascontiguousarray(getattr(flight, name)).tobytes() for name in ARRAYS)
    return hashlib.sha256(b"".join(arrays)).hexdigest()[:16]


_worlds: dict[tuple[type, str, int], World] = {}


def study_world(scenario: Scenario) -> World:
    """Makes the world of a flight, or returns it from the cache of the last `_MAX_WORLDS`."""
    key = type(scenario.world), dump_config(scenario.world), scenario.seed
    if key not in _worlds:
        while len(_worlds) >= _MAX_WORLDS:
            _worlds.pop(next(iter(_worlds)))
        _worlds[key] = make_world(scenario.world, scenario.seed)
    return _worlds[key]


@functools.lru_cache(maxsize=2)
def _difficulty(
    world: World, p_WS: tuple[float, ...], p_WG: tuple[float, ...], seed: int
) -> dict[str, float]:
    """Computes the measures of `Difficulty`; NaN without a path on its grid."""
    try:
        return asdict(world_difficulty(world, np.array(p_WS), np.array(p_WG), seed))
    except InfeasibleFlightError:
        return dict.fromkeys((field.name for field in fields(Difficulty)), math.nan)


@functools.lru_cache(maxsize=2)
def _lengths_to(world: World, p_WG: tuple[float, ...]) -> TimeOfArrival:
    field = world.esdf if world.esdf.occupied_outside else world.esdf.conservative()
    return path_lengths(field, np.array(p_WG))
