"""One flight of a study, a pure function of its specification, as worker processes run it."""

import functools
import hashlib
import io
import json
import platform
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Diagram

from splatpilot import _native
from splatpilot.analysis.benchmark.flight_measures import flight_measures, shortest_length
from splatpilot.analysis.benchmark.study import RolloutSpec, scenario_of
from splatpilot.diagrams.flight import Flight, decision_times, fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram, goal_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.configuration import dump_config, parse_config
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, way_lengths
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

ARRAYS = "times", "states", "commands", "clearances"
"""The arrays of `Flight` that a study keeps."""

ERROR = "error"
"""The outcome of a flight that an exception ended; it counts as a failure, and its row says why."""


class Rollout(NamedTuple):
    """What a flight leaves in a study."""

    row: dict[str, Any]
    """Its specification and measures: the same whenever and wherever it is flown."""
    trajectory: bytes
    """An .npz with `row` (JSON) and the arrays of `Flight` but the plans, in single precision; the
    same bytes too."""
    timing: dict[str, Any]
    """How long it took, and where."""


def fly_rollouts(specs: list[RolloutSpec], scenario: str, weights: dict[str, str]) -> list[Rollout]:
    """Flies some flights of one scenario, given as YAML, in this process.

    Configurations of Drake's own do not pickle, and so scenarios travel between processes as text.
    """
    parsed = parse_config(Scenario(), scenario, f"scenario {specs[0].scenario}")
    return [fly_rollout(spec, parsed, weights) for spec in specs]


def fly_rollout(
    spec: RolloutSpec, scenario: Scenario, weights: dict[str, str] | None = None
) -> Rollout:
    """Flies one flight of a study: `scenario` with the policy, speed and seed of `spec`; `weights`
    as for `scenario_of`."""
    started, cpu_started = time.perf_counter(), time.process_time()
    flown = scenario_of(spec, scenario, weights)
    timing: dict[str, Any] = {"id": spec.id}
    try:
        world = study_world(flown)
        timing["world_s"] = time.perf_counter() - started
        diagram = BuildFlightDiagram(flown, world, camera=False)
        flight = fly(diagram, flown, world)
        shortest = shortest_length(
            _way_lengths(world, flown), QuadrotorState.of(flight.states[0]).p_WB, flown.goal_radius
        )
        measures = flight_measures(flight, shortest) | {"digest": digest(flight)}
        timing |= _flight_timing(diagram, flown, flight)
    except FileNotFoundError:
        raise  # A scene that has gone is the study's error, not the flight's.
    except (ValueError, RuntimeError) as error:
        flight = None
        measures = {"success": False, "outcome": ERROR, "error": str(error)}
    timing |= {
        "total_s": time.perf_counter() - started,
        "total_cpu_s": time.process_time() - cpu_started,
        "host": platform.node(),
        "simd": _native.simd_levels()[0],
    }
    row = spec._asdict() | measures
    return Rollout({"id": spec.id} | row, encode(row, flight), timing)


def encode(row: dict[str, Any], flight: Flight | None) -> bytes:
    """The .npz of a flight; of one that an error ended without arrays."""
    arrays = {"row": np.array(json.dumps(row))}
    if flight is not None:
        arrays |= {name: getattr(flight, name).astype(np.float32) for name in ARRAYS}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def digest(flight: Flight) -> str:
    """What tells whether two flights are equal to the last bit."""
    arrays = (np.ascontiguousarray(getattr(flight, name)).tobytes() for name in ARRAYS)
    return hashlib.sha256(b"".join(arrays)).hexdigest()[:16]


def chunks(specs: list[RolloutSpec], size: int) -> Iterator[list[RolloutSpec]]:
    """Neighbours through the same place, at most `size` of them together."""
    chunk: list[RolloutSpec] = []
    for spec in specs:
        place = (spec.scenario, spec.seed)
        if chunk and (len(chunk) == size or place != (chunk[-1].scenario, chunk[-1].seed)):
            yield chunk
            chunk = []
        chunk.append(spec)
    if chunk:
        yield chunk


def _flight_timing(diagram: Diagram, scenario: Scenario, flight: Flight) -> dict[str, float]:
    render, decide = decision_times(diagram, scenario, flight)
    return {
        "flight_wall_s": flight.wall_time,
        "real_time_factor": float(flight.times[-1]) / flight.wall_time,
        "policy_ms": 1e3 * decide,
        "render_ms": 1e3 * render,
    }


def study_world(scenario: Scenario) -> World:
    """The world of a flight; the last two of a process are kept."""
    return _world(_Described(dump_config(scenario.world), scenario.world), scenario.seed)


class _Described(NamedTuple):
    """A configuration, compared by its YAML."""

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
    return way_lengths(field, np.array(p_WG))


def _way_lengths(world: World, scenario: Scenario) -> TimeOfArrival:
    return _lengths_to(world, tuple(goal_of(scenario, world)))
