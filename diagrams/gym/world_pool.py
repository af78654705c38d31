"""Worlds and flights for native code: those of `VectorFlightEnv`, and one flight of `FlightEnv`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from splatpilot import _native
from splatpilot.diagrams.flight.flight_diagram import FlightParts
from splatpilot.diagrams.flight.monitor import ENDS, Outcome
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
    sample_scenario,
)
from splatpilot.diagrams.gym.spaces import IMAGES, FlightEnvConfig, Vehicles
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import AnalyticDistanceField, shape_rows
from splatpilot.systems.common.config import is_configuration
from splatpilot.systems.common.distributions import is_distribution
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
from splatpilot.systems.vehicle.state import set_state

PACK = 16  # vehicles whose parameters lie together, see `_native.Vehicles`
_FLIGHTS = 64  # prepared in each world
_LOOKS = 4  # the same for worlds of random appearance, since each flight has one


class WorldPool:
    """Worlds that are baked and indexed, and flights in them that are ready to begin.

    Args:
        configs: whose worlds and flights are made, alike but for their scenarios.
        world: of all flights, instead of made ones.
    """

    def __init__(self, configs: Sequence[FlightEnvConfig], world: World | None = None) -> None:
        self.worlds: list[World] = []  # by appearances
        self.native = _native.FlightWorlds()
        self.scenarios: list[Scenario] = []  # (F,), of the flights
        self._made: World | None = None  # the last one
        self._fields: dict[int, int] = {}  # native numbers by the identity of distance fields
        self.sources = [(config.scenario, config.num_worlds) for config in configs]
        worlds, world_seeds, states, numbers = [], [], [], []
        turns = [(i, k) for i, config in enumerate(configs) for k in range(config.num_worlds)]
        for number, k in Progress(turns, "making worlds", unit="world", delay=1.0):
            config = configs[number]
            seed = config.scenario.seed + k
            made = self._add(world or make_world(config.scenario.world, seed))
            appearance = config.scenario.appearance
            is_varied = is_distribution(appearance) or appearance > 0.0
            drawn = np.random.default_rng([config.scenario.seed, k])
            for i in range(_LOOKS if is_varied else _FLIGHTS):
                flight_seed = int(drawn.integers(MAX_SEED))
                scenario = sample_scenario(replace(config.scenario, seed=flight_seed))
                require_supported(config, scenario)
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
                numbers.append(number)
                states.append(sample_initial_state(scenario, made))
                self.scenarios.append(scenario)
        self.world = np.array(worlds)  # (F,), index of `worlds`
        period = configs[0].scenario.controller.period
        # (F, CYCLE), of decisions, in periods
        drawn = [decision_delays(s.decision_delay, s.seed, period) for s in self.scenarios]
        self.delays = np.round(np.array(drawn) / period).astype(np.int32)
        self.is_delayed = bool(self.delays.any())
        self.seeds = np.array([s.seed for s in self.scenarios])  # (F,), of flights
        self.world_seeds = np.array(world_seeds)  # (F,)
        self.scenario = np.array(numbers)  # (F,), index of `configs`
        fields = np.array([self._fields[id(w.distance_field)] for w in self.worlds])[worlds]
        ends = zip(self.scenarios, worlds, strict=True)
        self.starts = {  # (F, ...), by the names of `VehicleArrays`
            "states": np.array(states),
            "goals": np.array([goal_position(s, self.worlds[w]) for s, w in ends]),
            "world": fields,
            "distances": query(self.native, np.array(states), fields)[0],
            "thrusts": np.array([s.vehicle.gravity for s in self.scenarios]),
            "goal_radii": np.array([s.goal_radius for s in self.scenarios]),
            "remaining": np.array([_periods(s) for s in self.scenarios]),
        }
        self.parameters = np.array([native_parameters(s) for s in self.scenarios])  # (F, P)
        self.actuated = not all(
            s.vehicle.is_ideal() and not any(s.wind.mean) for s in self.scenarios
        )
        radii = {s.vehicle.radius for s in self.scenarios}
        require(len(radii) == 1, "vehicle.radius", "the same in all flights", sorted(radii))
        (self.radius,) = radii

    def __len__(self) -> int:
        return len(self.scenarios)

    def _add(self, world: World) -> World:
        """Adds the distance field of a world to the native ones; returns the world, with the arrays
        of the last one if they are equal, as those of a captured scene are."""
        last, self._made = self._made, world
        if (
            last is not None
            and isinstance(world.distance_field, Esdf)
            and isinstance(last.distance_field, Esdf)
            and np.array_equal(world.gaussians.means, last.gaussians.means)
            and np.array_equal(world.gaussians.sh, last.gaussians.sh)
            and np.array_equal(world.esdf.distances, last.esdf.distances)
        ):
            shared = {"distance_field": last.distance_field, "esdf": last.esdf}
            self._made = replace(world, gaussians=last.gaussians, rendered=last.baked, **shared)
            return self._made
        require(world.moving is None, f"moving of {world.name}", "None", "moving obstacles", _OTHER)
        field = world.distance_field
        self._fields[id(field)] = add_field(self.native, field, world.name)
        return world


def _periods(scenario: Scenario) -> int:
    """Returns the number of periods of the controller until the timeout."""
    return math.ceil(scenario.timeout / scenario.controller.period - 1e-6)


def integration_steps(scenario: Scenario) -> dict[str, Any]:
    """Returns number and size [s] of steps in a period of the controller, as Drake divides it."""
    period = scenario.controller.period
    steps = max(1, math.ceil(period / scenario.simulator.max_step_size - 1e-6))
    return {"steps": steps, "step": period / steps}


class VehicleArrays:
    """The arrays of N vehicles, which native code updates."""

    def __init__(self, count: int, radius: float) -> None:
        self.states, self.goals = np.zeros((count, 13)), np.zeros((count, 3))
        self.distances, self.thrusts, self.goal_radii = np.zeros((3, count))
        self.field_states, self.ends = np.zeros((2, count), np.uint8)
        self.remaining, self.world = np.zeros(count, np.int32), np.zeros(count, np.int64)
        self.parameters = np.ones((-(-count // PACK), len(_native.FLIGHT_PARAMETERS), PACK))
        self.native = _native.Vehicles(**vars(self), radii=np.full(count, radius))


def query(
    worlds: _native.FlightWorlds, states: NDArray[np.float64], world: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns distances (N,) [m] and gradients (N, 3) of vehicles in worlds by number."""
    distances, gradients = np.empty(len(states)), np.empty((len(states), 3))
    worlds.query(
        p_WQ=np.ascontiguousarray(states[:, :3]),
        world=world,
        distances=distances,
        states=np.empty(len(states), np.uint8),
        gradients=gradients,
    )
    return distances, gradients


_OTHER = "use FlightEnv in gymnasium.vector.SyncVectorEnv"


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


def require_supported(config: FlightEnvConfig, scenario: Scenario) -> None:
    """Checks that `VectorFlightEnv` can fly `scenario`, that of the configuration, drawn."""
    neutral = {
        "moving": {},
        "estimator": TrueState(),
        "wind.gusts": 0,
        "controller.disturbance_time": 0,
        "vehicle.model": "lags",
        "vehicle.battery_sag": 0,
        "vehicle.ground_effect": 0,
        "simulator.integration_scheme": "runge_kutta5",
        "simulator.use_error_control": False,
    }
    if any(name in IMAGES for name in config.observation_names()):
        neutral |= {"observation": ObservationNoise(), "imaging": Imaging()}
        readout = config.camera.readout
        require(readout == 0.0, "camera.readout of VectorFlightEnv", "0", readout, _OTHER)
    for name, value in neutral.items():
        found, condition = attrgetter(name)(scenario), "left out" if value == {} else str(value)
        valid = found == value
        if is_configuration(value):
            is_other = type(found) is not type(value)
            found, condition = type(found).__name__ if is_other else "other values", "left out"
        require(valid, f"{name} of VectorFlightEnv", condition, found, _OTHER)
    longest, period = max(scenario.decision_delay, default=0.0), 1.0 / config.rate
    condition = f"at most the policy's period, {period:g} s, in VectorFlightEnv"
    require(longest <= period + 1e-9, "decision_delay", condition, longest, _OTHER)


def native_parameters(scenario: Scenario) -> NDArray[np.float64]:
    """Returns the numbers (P,) of `_native.FLIGHT_PARAMETERS`."""
    vehicle, control = scenario.vehicle, scenario.controller
    values = native_control(control, vehicle) | native_vehicle(vehicle, scenario.wind.mean)
    values |= {"response_time": RESPONSE_TIME, "max_acceleration": MAX_ACCELERATION}
    return np.array([values[name] for name in _native.FLIGHT_PARAMETERS])


# Fields of a scenario besides the start from which a seed draws values, if they are not defaults.
_RANDOM = ("appearance", "wind", "sensors", "observation", "imaging", "estimator", "decision_delay")
_OUTCOMES: tuple[Outcome | None, ...] = (None, *ENDS, Outcome.TIMEOUT)  # by the native ends


def only_start_is_random(scenario: Scenario) -> bool:
    """Checks if flights of a scenario in one world differ by seed in their start alone."""
    default = Scenario()
    steady = all(getattr(scenario, name) == getattr(default, name) for name in _RANDOM)
    return steady and sample_scenario(scenario) is scenario


def can_fly_natively(config: FlightEnvConfig, world: World) -> bool:
    """Checks if native code knows all systems of a flight that have a state."""
    scenario, simulator = config.scenario, config.scenario.simulator
    return (
        only_start_is_random(scenario)
        and scenario.vehicle.is_ideal()
        and scenario.controller.disturbance_time == 0.0
        and world.moving is None
        and not scenario.moving
        and config.camera.readout == 0.0
        and scenario.camera.output_delay == 0.0
        and simulator.integration_scheme == "runge_kutta5"
        and not simulator.use_error_control
        and isinstance(world.distance_field, AnalyticDistanceField | Esdf)
    )


class NativeFlight:
    """Flies the vehicle of a diagram, and sets its Context to the end of each step."""

    def __init__(self, config: FlightEnvConfig, parts: FlightParts, root: Context) -> None:
        scenario, world = config.scenario, parts.world
        self._config, self._root, self._parts = config, root, parts
        self._plant = parts.plant.GetMyMutableContextFromRoot(root)
        self._controller = parts.controller and parts.controller.GetMyMutableContextFromRoot(root)
        self._worlds, self._threads = _native.FlightWorlds(), _native.FlightThreads(1)
        add_field(self._worlds, world.distance_field, world.name)
        self._parameters = native_parameters(scenario)
        self._arrays = VehicleArrays(1, scenario.vehicle.radius)
        self._arrays.parameters[:] = self._parameters[:, None]
        self._arrays.goal_radii[:] = scenario.goal_radius
        self._period = scenario.controller.period
        self._steps = integration_steps(scenario)
        self._limit = _periods(scenario)
        self._flying, self._delay = np.ones(1, bool), np.zeros(1, np.int32)
        self._with_gradient = "obstacle" in config.observation_names()

    def begin(self, state: NDArray[np.float64], p_WG: NDArray[np.float64]) -> None:
        """Begins a flight from a state (13,) to a goal (3,) [m]."""
        arrays = self._arrays
        arrays.states[0], arrays.goals[0], arrays.remaining[0] = state, p_WG, self._limit
        arrays.distances[:], _ = query(self._worlds, arrays.states, arrays.world)

    def step(self, decision: NDArray[np.float64], periods: int) -> Outcome | None:
        """Flies with a decision (1, n) for periods of the controller; returns the outcome."""
        arrays = self._arrays
        changed = arrays.states, arrays.distances, arrays.field_states, arrays.remaining
        start = [array.copy() for array in changed]
        if periods > 1:
            self._advance(decision, periods - 1)
            if arrays.ends[0]:  # Fly again until the last period.
                flown = int(start[3][0] - arrays.remaining[0])
                for array, first in zip(changed, start, strict=True):
                    array[:] = first
                if flown > 1:
                    self._advance(decision, flown - 1)
        before = arrays.states[0].copy()
        self._advance(decision, 1)
        self._root.SetTime((self._limit - int(arrays.remaining[0])) * self._period)
        set_state(self._plant, arrays.states[0].tolist())
        if self._controller is not None:
            command, kind = np.empty(4), self._config.action
            _native.flight_command(kind, before, decision[0], self._parameters, command)
            self._controller.SetDiscreteState(0, command)
        return _OUTCOMES[arrays.ends[0]]

    def _advance(self, decision: NDArray[np.float64], periods: int) -> None:
        self._threads.advance(
            self._worlds,
            self._arrays.native,
            kind=self._config.action,
            actions=decision,
            earlier=decision,
            delays=self._delay,
            flying=self._flying,
            actuated=False,
            periods=periods,
            **self._steps,
        )

    def vehicles(self) -> Vehicles:
        """Returns the vehicle; its gradient is zero unless an observation needs it."""
        arrays, gradients = self._arrays, np.zeros((1, 3))
        if self._with_gradient:
            _, gradients = query(self._worlds, arrays.states, arrays.world)
        vehicle = arrays.states.copy(), arrays.goals.copy(), arrays.distances.copy()
        return Vehicles(*vehicle, gradients)
