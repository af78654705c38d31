"""Prepared worlds and flights, from which the vehicles of `VectorFlightEnv` draw."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpilot import _native
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
    sample_scenario,
)
from splatpilot.diagrams.gym.spaces import IMAGES, OBSERVATIONS, FlightEnvConfig
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import AnalyticDistanceField, shape_rows
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import MAX_SEED, require, require_type
from splatpilot.systems.policies.velocity import MAX_ACCELERATION, RESPONSE_TIME
from splatpilot.systems.sensing.estimators import TrueState
from splatpilot.systems.sensing.imaging import Imaging
from splatpilot.systems.sensing.latency import decision_delays
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.vehicle.flatness import native_control
from splatpilot.systems.vehicle.quadrotor import native_vehicle

PACK = 16  # vehicles whose parameters lie together, see `_native.Vehicles`
_FLIGHTS = 64  # prepared in each world
_LOOKS = 4  # the same for worlds of random appearance, since each flight has one


class WorldPool:
    """Worlds that are baked and indexed, and flights in them that are ready to begin.

    A flight is that of its scenario, with its seed, in its world: `AddFlight` flies the same.

    Args:
        configs: whose worlds and flights are made, alike but for their scenarios.
        world: of all flights, instead of made ones.

    Raises:
        InfeasibleFlightError: for a world, start or goal that cannot be flown.
        ValueError: for a scenario that native code cannot fly, by the name of its field.
    """

    def __init__(self, configs: Sequence[FlightEnvConfig], world: World | None = None) -> None:
        self.worlds: list[World] = []  # by appearances
        self.native = _native.FlightWorlds()
        self.scenarios: list[Scenario] = []  # (F,), of the flights
        self._made: World | None = None  # the last one
        self._fields: dict[int, int] = {}  # native numbers by the identity of distance fields
        self._configs = list(configs)
        worlds, world_seeds, states = [], [], []
        turns = [(config, k) for config in configs for k in range(config.num_worlds)]
        for config, k in Progress(turns, "making worlds", unit="world", delay=1.0):
            seed = config.scenario.seed + k
            made = self._add(world or make_world(config.scenario.world, seed))
            is_varied = config.scenario.appearance > 0.0
            drawn = np.random.default_rng([config.scenario.seed, k])
            for i in range(_LOOKS if is_varied else _FLIGHTS):
                flight_seed = int(drawn.integers(MAX_SEED))
                scenario = sample_scenario(replace(config.scenario, seed=flight_seed))
                if is_varied or i == 0:
                    self.worlds.append(
                        randomize_appearance(made, scenario.appearance, scenario.seed)
                    )
                    if any(name in IMAGES for name in config.observation_names()):
                        # Now, rather than at the first image.
                        kind = type(self.worlds[-1].baked)
                        what = f"the scene of {made.name} in images"
                        require(kind is BakedScene, what, "of Gaussians", kind.__name__, _OTHER)
                worlds.append(len(self.worlds) - 1)
                world_seeds.append(seed)
                states.append(sample_initial_state(scenario, made))
                self.scenarios.append(scenario)
        self.world = np.array(worlds)  # (F,), index of `worlds`
        self.field = np.array([self._fields[id(w.distance_field)] for w in self.worlds])[worlds]
        self.states = np.array(states)  # (F, 13)
        self.p_WG = np.array(
            [goal_position(s, self.worlds[w]) for s, w in zip(self.scenarios, worlds, strict=True)]
        )
        period = configs[0].scenario.controller.period
        # (F, CYCLE), of decisions, in periods
        delays = np.array([decision_delays(s.decision_delay, s.seed) for s in self.scenarios])
        self.delays = np.ceil(delays / period - 1e-9).astype(np.int32)
        self.is_delayed = bool(self.delays.any())
        self.seeds = np.array([s.seed for s in self.scenarios])  # (F,), of flights
        self.world_seeds = np.array(world_seeds)  # (F,)
        self.distances = np.empty(len(self))  # (F,) [m], from the start to surfaces
        self.native.query(
            p_WQ=np.ascontiguousarray(self.states[:, :3]),
            world=self.field,
            distances=self.distances,
            states=np.empty(len(self), np.uint8),
        )
        self.parameters = np.array([native_parameters(s) for s in self.scenarios])  # (F, P)
        self.actuated = not all(
            s.vehicle.is_ideal() and not any(s.wind.mean) for s in self.scenarios
        )
        self.thrusts = np.array([s.vehicle.gravity for s in self.scenarios])
        self.goal_radii = np.array([s.goal_radius for s in self.scenarios])
        limits = [math.ceil(s.timeout / period - 1e-6) for s in self.scenarios]
        self.periods = np.array(limits, np.int32)  # (F,), of the controller until the timeout
        radii = {s.vehicle.radius for s in self.scenarios}
        require(len(radii) == 1, "vehicle.radius", "the same in all flights", sorted(radii))
        (self.radius,) = radii

    def __len__(self) -> int:
        return len(self.scenarios)

    def matches(self, configs: Sequence[FlightEnvConfig]) -> bool:
        """Checks if the pool has the flights of these configurations."""
        given, made = (
            [(c.scenario, c.num_worlds) for c in each] for each in (configs, self._configs)
        )
        return given == made

    def _add(self, world: World) -> World:
        """Adds the distance field of a world to the native ones; returns the world, with the arrays
        of the last one if they are equal, as those of a captured scene are."""
        last, self._made = self._made, world
        if last is not None and _are_equal(world, last):
            shared = {"distance_field": last.distance_field, "esdf": last.esdf}
            self._made = replace(world, gaussians=last.gaussians, rendered=last.baked, **shared)
            return self._made
        require(world.moving is None, f"moving of {world.name}", "None", "moving obstacles", _OTHER)
        field = world.distance_field
        self._fields[id(field)] = add_field(self.native, field, world.name)
        return world


_OTHER = "use FlightEnv in gymnasium.vector.SyncVectorEnv"


def _are_equal(world: World, other: World) -> bool:
    fields = world.distance_field, other.distance_field
    return (
        all(isinstance(field, Esdf) for field in fields)
        and np.array_equal(world.gaussians.means, other.gaussians.means)
        and np.array_equal(world.gaussians.sh, other.gaussians.sh)
        and np.array_equal(world.esdf.distances, other.esdf.distances)
    )


def add_field(worlds: _native.FlightWorlds, field: DistanceField, name: str) -> int:
    """Adds a distance field of the world `name` to native ones; returns its number."""
    if isinstance(field, Esdf):
        return worlds.add_grid(
            distances=field.distances,
            states=field.states,
            lower_W=field.lower_W,
            upper_W=field.upper_W,
            voxel_size=field.voxel_size,
            occupied_outside=field.occupied_outside,
        )
    require_type(field, AnalyticDistanceField, f"distance_field of {name}", "or an Esdf")
    assert isinstance(field, AnalyticDistanceField)  # for type checkers
    rows, kinds = shape_rows(field.shapes)
    return worlds.add_shapes(shapes=rows, kinds=kinds, lower_W=field.lower_W, upper_W=field.upper_W)


def require_supported(config: FlightEnvConfig) -> None:
    """Raises ValueError for what `VectorFlightEnv` cannot fly, by the name of the field."""
    scenario = sample_scenario(config.scenario)
    vehicle, simulator = scenario.vehicle, scenario.simulator
    scheme, estimator = simulator.integration_scheme, type(scenario.estimator).__name__
    images = [n for n in config.observation_names() if n in IMAGES]
    disturbance = scenario.controller.disturbance_time
    neutral: dict[str, tuple[bool, str, Any]] = {
        "moving": (not scenario.moving, "empty", list(scenario.moving)),
        "estimator": (isinstance(scenario.estimator, TrueState), "TrueState", estimator),
        "wind.gusts": (scenario.wind.gusts == 0.0, "0", scenario.wind.gusts),
        "controller.disturbance_time": (disturbance == 0.0, "0", disturbance),
        "vehicle.model": (vehicle.model == "lags", "lags", vehicle.model),
        "vehicle.battery_sag": (vehicle.battery_sag == 0.0, "0", vehicle.battery_sag),
        "vehicle.ground_effect": (vehicle.ground_effect == 0.0, "0", vehicle.ground_effect),
        "simulator.integration_scheme": (scheme == "runge_kutta5", "runge_kutta5", scheme),
        "simulator.use_error_control": (
            not simulator.use_error_control, "false", simulator.use_error_control
        ),
        "observation": (
            not images or scenario.observation == ObservationNoise(), "left out", "noise or latency"
        ),
        "imaging": (not images or scenario.imaging == Imaging(), "left out", "image formation"),
        "camera.readout": (not images or config.camera.readout == 0.0, "0", config.camera.readout),
    }  # fmt: skip
    for name, (valid, condition, value) in neutral.items():
        require(valid, f"{name} of VectorFlightEnv", condition, value, _OTHER)
    for name in config.observation_names():
        known = f"one of {', '.join(OBSERVATIONS)} in VectorFlightEnv"
        require(name in OBSERVATIONS, "observation", known, repr(name), _OTHER)
    longest, period = max(scenario.decision_delay, default=0.0), 1.0 / config.rate
    condition = f"at most the policy's period, {period:g} s, in VectorFlightEnv"
    require(longest <= period + 1e-9, "decision_delay", condition, longest, _OTHER)


def native_parameters(scenario: Scenario) -> NDArray[np.float64]:
    """Returns the numbers (P,) of `_native.FLIGHT_PARAMETERS`."""
    vehicle, control = scenario.vehicle, scenario.controller
    values = native_control(control, vehicle) | native_vehicle(vehicle, scenario.wind.mean)
    values |= {"response_time": RESPONSE_TIME, "max_acceleration": MAX_ACCELERATION}
    return np.array([values[name] for name in _native.FLIGHT_PARAMETERS])
