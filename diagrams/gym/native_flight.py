"""One flight of AddFlight, flown by the native code of VectorFlightEnv."""

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from splatpilot import _native
from splatpilot.diagrams.flight.flight_diagram import FlightParts
from splatpilot.diagrams.flight.monitor import ENDS, Outcome
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.diagrams.gym.spaces import FlightEnvConfig, Vehicles
from splatpilot.diagrams.gym.world_pool import PACK, add_field, native_parameters
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import AnalyticDistanceField
from splatpilot.systems.vehicle.state import set_state

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
        and world.moving is None
        and not scenario.moving
        and config.camera.readout == 0.0
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
        self._state, self._p_WG = np.zeros((1, 13)), np.zeros((1, 3))
        self._distance, self._field_state = np.zeros(1), np.zeros(1, np.uint8)
        self._end, self._remaining = np.zeros(1, np.uint8), np.zeros(1, np.int32)
        self._world = np.zeros(1, np.int64)
        self._vehicles = _native.Vehicles(
            states=self._state,
            thrusts=np.zeros(1),
            parameters=np.repeat(self._parameters[None, :, None], PACK, axis=-1),
            world=self._world,
            goals=self._p_WG,
            radii=np.full(1, scenario.vehicle.radius),
            goal_radii=np.full(1, scenario.goal_radius),
            remaining=self._remaining,
            distances=self._distance,
            field_states=self._field_state,
            ends=self._end,
        )
        self._period = scenario.controller.period
        self._steps = max(1, int(np.ceil(self._period / scenario.simulator.max_step_size - 1e-6)))
        self._limit = int(np.ceil(scenario.timeout / self._period - 1e-6))
        self._flying, self._delay = np.ones(1, bool), np.zeros(1, np.int32)
        self._with_gradient = "obstacle" in config.observation_names()

    def begin(self, state: NDArray[np.float64], p_WG: NDArray[np.float64]) -> None:
        """Begins a flight from a state (13,) to a goal (3,) [m]."""
        self._state[0], self._p_WG[0], self._remaining[0] = state, p_WG, self._limit
        self._query()

    def step(self, decision: NDArray[np.float64], periods: int) -> Outcome | None:
        """Flies with a decision (1, n) for periods of the controller; returns the outcome."""
        arrays = self._state, self._distance, self._field_state, self._remaining
        start = [array.copy() for array in arrays]
        if periods > 1:
            self._advance(decision, periods - 1)
            if self._end[0]:  # Fly again until the last period.
                flown = int(start[3][0] - self._remaining[0])
                for array, first in zip(arrays, start, strict=True):
                    array[:] = first
                if flown > 1:
                    self._advance(decision, flown - 1)
        before = self._state[0].copy()
        self._advance(decision, 1)
        self._write(before, decision[0])
        return _OUTCOMES[self._end[0]]

    def _advance(self, decision: NDArray[np.float64], periods: int) -> None:
        self._threads.advance(
            self._worlds,
            self._vehicles,
            kind=self._config.action,
            actions=decision,
            earlier=decision,
            delays=self._delay,
            flying=self._flying,
            actuated=False,
            periods=periods,
            step=self._period / self._steps,
            steps=self._steps,
        )

    def _write(self, before: NDArray[np.float64], decision: NDArray[np.float64]) -> None:
        """Sets time, state and command of the Context; `before` is the state at the command."""
        self._root.SetTime((self._limit - int(self._remaining[0])) * self._period)
        set_state(self._plant, self._state[0].tolist())
        if self._controller is not None:
            command = np.empty(4)
            kind = self._config.action
            _native.flight_command(kind, before, decision, self._parameters, command)
            self._controller.SetDiscreteState(0, command)

    def _query(self, gradients: NDArray[np.float64] | None = None) -> None:
        self._worlds.query(
            p_WQ=self._state[:, :3].copy(),
            world=self._world,
            distances=self._distance,
            states=self._field_state,
            gradients=gradients,
        )

    def vehicles(self) -> Vehicles:
        """Returns the vehicle; its gradient is zero unless an observation needs it."""
        gradients = np.zeros((1, 3))
        if self._with_gradient:
            self._query(gradients)
        return Vehicles(self._state.copy(), self._p_WG.copy(), self._distance.copy(), gradients)
