"""FlightEnv: one flight as a Gymnasium environment."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    OutputPort,
    PortDataType,
    System,
)
from pydrake.systems.sensors import ImageDepth16U, ImageDepth32F, ImageRgba8U

from splatpilot.diagrams.flight.blocks import DecisionInput
from splatpilot.diagrams.flight.flight_diagram import (
    AddFlight,
    AddMeshcat,
    ExportFlight,
    FlightParts,
    open_meshcat,
)
from splatpilot.diagrams.flight.monitor import ENDS, Outcome
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
)
from splatpilot.diagrams.gym.spaces import (
    IMAGES,
    TERMINATED,
    Transition,
    Vehicles,
    action_space,
    decisions,
    env_config,
    find_scenario,
    observation_space,
    observe,
    observe_image,
    require_actions,
    require_options,
)
from splatpilot.diagrams.gym.world_pool import (
    NativeFlight,
    can_fly_natively,
    only_start_is_random,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.validation import MAX_SEED, require
from splatpilot.systems.vehicle.state import set_state


class FlightEnv(gymnasium.Env):
    """A flight of `AddFlight` as an environment; a step is one period of the policy.

        env = gymnasium.make("splatpilot:Flight-v0", scenario="P02", observation=["depth", "goal"])

    Observations are those of `observe` and `observe_image`, and outputs of the scenario's sensors,
    such as `imu_accelerometer`. Actions are in [-1, 1], see `decisions`. A flight is terminated by
    a collision, at the goal, and outside of the known volume, and truncated by the scenario's
    timeout; then `info` has the `outcome` and `is_success`. The end is found within 0.02 s.

    As in Drake's `DrakeGymEnv`, `simulator` is that of the present flight and `time_step` the time
    of a step [s]. Resets draw the world, the start and noise; those with a seed repeat.

    Args:
        scenario: as such, a name such as "P02", or a YAML file. Its policy is not used.
        render_mode: "rgb_array": the scenario's camera; "human": Meshcat, in real time.
        native: flies by the native code of `VectorFlightEnv` if that knows all systems with a
            state, and sets the Context; otherwise, and in "human" mode, the simulator advances.
        world: of all flights; by default `num_worlds` are made of seeds from the scenario's on.
        fields: of `FlightEnvConfig`.

    Raises:
        InfeasibleFlightError: also by `reset`, for a world, start or goal that cannot be flown.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str | Path = "P01",
        *,
        render_mode: str | None = None,
        world: World | None = None,
        native: bool = True,
        **fields: Any,
    ) -> None:
        modes = self.metadata["render_modes"]
        known = f"one of {', '.join(modes)}, or None"
        require(render_mode in (None, *modes), "render_mode", known, repr(render_mode))
        self.config = env_config(scenario, world, **fields)
        self.render_mode, self._world = render_mode, world
        self.metadata = self.metadata | {"render_fps": self.config.rate}
        self.time_step = 1.0 / self.config.rate
        self._worlds: dict[Any, World] = {}
        self._flights: dict[int, _BuiltFlight] = {}  # by the identity of their world
        self._native = native
        self.meshcat: Meshcat | None = None
        self._ended = True
        world = self._find_world(self.config.scenario)
        self._take_flight(self.config.scenario, world)
        self._spaces, self.observation_space = self._find_spaces()
        self.action_space = action_space(self.config)

    def _find_spaces(self) -> tuple[dict[str, Box], gymnasium.Space[Any]]:
        """Returns the spaces of observed outputs of sensors, and that of all observations."""
        ports, names = self.parts.measured, self.config.observation_names()
        spaces = {n: _port_space(ports[n]) for n in names if n in ports}
        return spaces, observation_space(self.config, spaces, ports)

    def _find_world(self, scenario: Scenario) -> World:
        if self._world is not None:
            return self._world
        key = repr(scenario.world), scenario.seed
        if key not in self._worlds:
            if len(self._worlds) >= _MAX_WORLDS:
                oldest = self._worlds.pop(next(iter(self._worlds)))
                self._flights.pop(id(oldest), None)
            self._worlds[key] = make_world(scenario.world, scenario.seed)
        return self._worlds[key]

    def _build(self, scenario: Scenario, world: World) -> "_BuiltFlight":
        builder, config = DiagramBuilder(), self.config
        policy = DecisionInput(config.action, config.camera, config.rate)
        camera = self.render_mode is not None
        parts = AddFlight(builder, scenario, world, policy=policy, camera=camera, logs=False)
        if self.render_mode == "human":
            self.meshcat = open_meshcat(scenario, world, self.meshcat)
            AddMeshcat(builder, parts, self.meshcat)
        ExportFlight(builder, parts)
        simulator = Simulator(builder.Build())
        ApplySimulatorConfig(scenario.simulator, simulator)
        if self.render_mode == "human":
            simulator.set_target_realtime_rate(1.0)
        return _BuiltFlight(parts, simulator)

    def _take_flight(self, scenario: Scenario, world: World) -> None:
        """Takes the flight of a world, or a new one if noise differs from flight to flight, or to
        draw its world."""
        flight = self._flights.get(id(world)) or self._build(scenario, world)
        is_kept = only_start_is_random(self.config.scenario) and self.render_mode != "human"
        if is_kept and id(world) not in self._flights:
            self._flights[id(world)] = flight
            if self._native and can_fly_natively(self.config, world):
                context = flight.simulator.get_mutable_context()
                flight.native = NativeFlight(self.config, flight.parts, context)
        self._flight, self.parts, self.simulator = flight, flight.parts, flight.simulator
        self.diagram = cast(Diagram, self.simulator.get_system())
        self._action = self.diagram.GetInputPort(self.config.action)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins a flight.

        Args:
            seed: of the generator that draws worlds, starts and noise from now on.
            options: `scenario`, flown from now on; `start` and `goal` (3) [m] of this flight.
        """
        super().reset(seed=seed)
        self._ended = True  # also if this fails
        options = options or {}
        points = require_options(options, "scenario")
        if "scenario" in options:
            config = replace(self.config, scenario=find_scenario(options["scenario"]))
            config.validate()
            require(self._world is None, "world", "left out with options of a scenario", "a world")
            self.config = config
            self._flights.clear()
        base, draw = self.config.scenario, self.np_random.integers
        world_seed = base.seed + int(draw(self.config.num_worlds))
        scenario = replace(base, seed=int(draw(MAX_SEED)), **points)
        if points:
            scenario.validate()
        world = self._find_world(replace(base, seed=world_seed))
        self._take_flight(scenario, world)
        same = not self._spaces or self._find_spaces()[0] == self._spaces
        require(same, "sensors of the scenario", "those of the observations", "others")
        context = self.simulator.get_mutable_context()
        if only_start_is_random(base):
            world = self.parts.world  # with moving obstacles
            state = sample_initial_state(scenario, world)
            p_WG = goal_position(scenario, world)
            context.SetTime(0.0)
            self.diagram.SetDefaultContext(context)
            set_state(self.parts.plant.GetMyMutableContextFromRoot(context), state)
            source: Any = self.parts.goal.get_system()
            goal = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context))
            goal.SetFromVector(p_WG)
            if self._flight.native:
                self._flight.native.begin(state, p_WG)
        else:
            self.diagram.SetRandomContext(context, RandomGenerator(scenario.seed))
        self._vehicles = self._flight.vehicles()
        self._previous = np.zeros((1, *cast(Box, self.action_space).shape))
        hover = decisions(self.config, self._previous, self._vehicles.states)
        self._action.FixValue(context, hover[0])
        self.simulator.Initialize()
        self._steps, self._ended = 0, False
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies for one period with an action in [-1, 1]."""
        if self._ended:
            raise gymnasium.error.ResetNeeded("the flight must be begun by reset() before step()")
        config, scenario, before = self.config, self.parts.scenario, self._vehicles
        actions = require_actions(action, cast(Box, self.action_space).shape)[None]
        decision = decisions(config, actions, self._estimates)
        self._action.FixValue(self.simulator.get_mutable_context(), decision[0])
        self._steps += 1
        flight, period = self._flight, scenario.controller.period
        periods = round(self.time_step / period)
        if flight.native:
            outcome = flight.native.step(decision, periods)
        else:
            # The time of the controller's update as Drake computes it, which saves a tiny step.
            end = self._steps * periods * period
            self.simulator.AdvanceTo(min(end, scenario.timeout))
            outcome = flight.parts.monitor.outcome(flight.monitor_context)
        self._vehicles = flight.vehicles()
        transition = Transition(
            states=before.states,
            next_states=self._vehicles.states,
            p_WG=before.p_WG,
            distances=self._vehicles.distances,
            actions=actions,
            previous_actions=self._previous,
            reached=np.array([outcome is Outcome.GOAL]),
            failed=np.array([outcome in (Outcome.COLLISION, Outcome.LEFT_VOLUME)]),
            duration=self.time_step,
            radius=scenario.vehicle.radius,
        )
        reward = np.asarray(config.reward(transition))
        require(reward.shape == (1,), "shape of the reward", "(N,) = (1,)", reward.shape)
        if outcome is None and config.terminates(transition)[0]:
            outcome = TERMINATED
        self._previous, self._ended = actions, outcome is not None
        info: dict[str, Any] = {}
        if outcome is not None:
            info = {"outcome": str(outcome), "is_success": outcome is Outcome.GOAL}
        terminated, truncated = outcome in (*ENDS, TERMINATED), outcome is Outcome.TIMEOUT
        return self._observe(), float(reward[0]), terminated, truncated, info

    def _observe(self) -> Any:
        names, vehicles = self.config.observation_names(), self._vehicles
        if self.parts.estimator is not None:
            vehicles = vehicles._replace(states=self._flight.eval("state")[None])
        self._estimates = vehicles.states
        observed: dict[str, Any] = {n: v[0] for n, v in observe(names, vehicles).items()}
        for name in names:
            if name in IMAGES:
                image = self._flight.eval(IMAGES[name])
                observed[name] = observe_image(name, image, self.config.camera.max_depth)
            elif name not in observed:
                observed[name] = self._flight.eval(name).astype(self._spaces[name].dtype)
        return self.config.arrange(observed)

    def render(self) -> NDArray[np.uint8] | None:
        """Returns the image (H, W, 3) of the scenario's camera, or publishes to Meshcat."""
        context = self.simulator.get_context()
        if self.render_mode == "human":
            self.diagram.ForcedPublish(context)
        if self.render_mode != "rgb_array":
            return None
        image: Any = self.diagram.GetOutputPort("color_image").Eval(context)
        return np.array(image.data[..., :3])


_MAX_WORLDS = 64  # that are kept


class _BuiltFlight:
    """A diagram of a flight with its simulator, and how it is read and flown."""

    def __init__(self, parts: FlightParts, simulator: Simulator) -> None:
        self.parts, self.simulator = parts, simulator
        self.native: NativeFlight | None = None
        root, collision = simulator.get_mutable_context(), parts.collision
        self.monitor_context = parts.monitor.GetMyContextFromRoot(root)
        ports = {n: collision.GetOutputPort(n) for n in ("distance", "gradient")}
        ports |= parts.observation | {"goal": parts.goal, "true_state": parts.state}
        self._ports = {
            name: (port, cast(System, port.get_system()).GetMyContextFromRoot(root))
            for name, port in ports.items()
        }

    def eval(self, name: str) -> NDArray[Any]:
        """Returns a copy of the vector or image at an output port."""
        port, context = self._ports[name]
        value: Any = port.Eval(context)
        is_vector = port.get_data_type() == PortDataType.kVectorValued
        return np.array(value if is_vector else _plain(value.data))

    def vehicles(self) -> Vehicles:
        """Returns the vehicle, with its true state."""
        if self.native:
            return self.native.vehicles()
        names = "true_state", "goal", "distance", "gradient"
        state, goal, distance, gradient = map(self.eval, names)
        return Vehicles(state[None], goal[None], distance, gradient[None])


_MAX_VALUES = {ImageRgba8U: 255, ImageDepth32F: np.inf, ImageDepth16U: 65535}


def _port_space(port: OutputPort) -> Box:
    """Returns the space of a sensor's output: a vector, or an image (H, W) or (H, W, 4)."""
    if port.get_data_type() == PortDataType.kVectorValued:
        return Box(-np.inf, np.inf, (port.size(),), np.float32)
    image: Any = port.Allocate().get_value()
    known = f"a vector or one of {', '.join(kind.__name__ for kind in _MAX_VALUES)}"
    what = f"the output {port.get_name()!r}"
    require(type(image) in _MAX_VALUES, what, known, type(image).__name__)
    pixels = _plain(image.data)
    return Box(0, _MAX_VALUES[type(image)], pixels.shape, pixels.dtype.type)


def _plain(pixels: NDArray[Any]) -> NDArray[Any]:
    """Returns an image (H, W, n) without its last axis if n = 1."""
    return pixels[..., 0] if pixels.shape[-1] == 1 else pixels
