"""VectorFlightEnv: many flights as one Gymnasium environment, flown as arrays by native code."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from splatpilot import _native
from splatpilot.diagrams.flight.blocks import camera_info, camera_mount
from splatpilot.diagrams.flight.monitor import ENDS, Outcome
from splatpilot.diagrams.flight.scenario import (
    Scenario,
    goal_position,
    sample_initial_state,
    sample_scenario,
)
from splatpilot.diagrams.gym.spaces import (
    IMAGES,
    TERMINATED,
    Transition,
    Vehicles,
    action_space,
    decisions,
    env_config,
    observation_space,
    observe,
    observe_image,
    require_actions,
    require_options,
)
from splatpilot.diagrams.gym.world_pool import (
    PACK,
    VehicleArrays,
    WorldPool,
    integration_steps,
    query,
    require_supported,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.processes import available_cores
from splatpilot.systems.common.validation import MAX_SEED, require, require_type
from splatpilot.systems.sensing.latency import CYCLE
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.baked_scene import BatchRenderer
from splatpilot.systems.splats.splat_camera import color_pixels, ranged_depth
from splatpilot.systems.vehicle.state import pose_from_state

# By the native ends, and one more
_OUTCOMES = np.array([None, *ENDS, Outcome.TIMEOUT, TERMINATED], dtype=object)
_GOAL, _TIMEOUT, _TERMINATED = map(
    list(_OUTCOMES).index, (Outcome.GOAL, Outcome.TIMEOUT, TERMINATED)
)


class VectorFlightEnv(VectorEnv):
    """Many flights of `AddFlight` as one environment, each in a world of its own.

        envs = gymnasium.make_vec("splatpilot:Flight-v0", num_envs=64, scenario="P02")

    Observations, actions, rewards and ends are those of `FlightEnv`; the end of a flight is found
    after each period of the controller. Flights equal those of `AddFlight` with the seeds in the
    infos of `reset` within rounding, and do not depend on the number of threads.

    Each flight is drawn from a `WorldPool`, whose worlds are made at the beginning, each with 64
    flights (4 with random appearance): starts, goals and values of the scenario's distributions.
    Environment i of a `reset` with the seed s draws its flights from the seed s + i.

    When a flight ends, infos have its `outcome` and `is_success`, by environments, and masks of
    the environments that have them, `_outcome` and `_is_success`. Then and when the next begins,
    they have its number `scenario` and seeds `world_seed` and `flight_seed`, as those of `reset`.

    Args:
        num_envs: number of environments.
        scenario: as for `FlightEnv`; of several, each has `num_worlds` worlds.
        autoreset_mode: of `gymnasium.vector.AutoresetMode`.
        render_mode: "rgb_array" renders the scenario's camera.
        threads: of native code; by default one per processor.
        world: of all flights, as for `FlightEnv`.
        pool: that of another environment with the same scenarios.
        fields: of `FlightEnvConfig`.

    Raises:
        InfeasibleFlightError: also by `reset`, for a world, start or goal that cannot be flown.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | Sequence[Scenario | str | Path] = "P01",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        threads: int | None = None,
        world: World | None = None,
        pool: WorldPool | None = None,
        **fields: Any,
    ) -> None:
        require_type(num_envs, int, "num_envs", "name the scenario: scenario=...")
        require(num_envs >= 1, "num_envs", "at least 1", num_envs)
        known = "rgb_array or None"
        require(render_mode in (None, "rgb_array"), "render_mode", known, repr(render_mode))
        scenarios = [scenario] if isinstance(scenario, Scenario | str | Path) else list(scenario)
        require(scenarios, "scenario", "one or several scenarios", scenarios)
        require(world is None or pool is None, "world", "left out with a pool", world)
        configs = [env_config(each, world, **fields) for each in scenarios]
        self.num_envs, self.render_mode, self.config = num_envs, render_mode, configs[0]
        modes = [mode.value for mode in AutoresetMode]
        valid = autoreset_mode in [*AutoresetMode, *modes]
        require(valid, "autoreset_mode", f"one of {', '.join(modes)}", repr(autoreset_mode))
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "autoreset_mode": self._mode,
            "render_modes": ["rgb_array"],
            "render_fps": self.config.rate,
        }
        for config in configs:
            require_supported(config, sample_scenario(config.scenario))
        self.single_observation_space = observation_space(self.config)
        self.single_action_space = action_space(self.config)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.time_step = 1.0 / self.config.rate
        for name in ("controller.period", "simulator.max_step_size", "vehicle.gravity"):
            values = {attrgetter(name)(config.scenario) for config in configs}
            require(len(values) == 1, name, "the same in all scenarios", sorted(values))
        self._steps = integration_steps(self.config.scenario)
        self._steps["periods"] = round(self.time_step / self.config.scenario.controller.period)
        threads = threads or available_cores()
        self._threads, self._renderer = _native.FlightThreads(threads), BatchRenderer(threads)
        self.pool = pool or WorldPool(configs, world)
        same = self.pool.sources == [(config.scenario, config.num_worlds) for config in configs]
        require(same, "pool", "that of the same scenarios and num_worlds", "another")
        n, size = num_envs, self.single_action_space.shape[0]
        self._flight = np.zeros(n, int)  # index in the pool
        self._arrays = VehicleArrays(n, self.pool.radius)
        self._delays, self._decisions = np.zeros(n, np.int32), np.zeros((n, size))
        self._previous, self._count = np.zeros((n, size)), np.zeros(n, np.int64)
        self._seeds, self._episodes = np.zeros(n, np.uint64), np.zeros(n, np.uint64)
        self._choices = np.arange(len(self.pool))
        self._ended = np.ones(n, bool)
        self._begun = np.zeros(n, bool)  # by a reset that did not fail
        self._last: Any = None  # observations, if environments are reset by masks

    @property
    def choices(self) -> NDArray[np.intp]:
        """Numbers of the pool's flights to draw among; set others for a curriculum."""
        return self._choices

    @choices.setter
    def choices(self, flights: ArrayLike) -> None:
        flights = np.array(flights)
        valid = flights.ndim == 1 and flights.dtype.kind in "iu" and self._in_pool(flights)
        require(valid, "choices", f"one or more in [0, {len(self.pool)})", flights.tolist())
        self._choices = flights

    def _in_pool(self, flights: NDArray[np.intp]) -> bool:
        return bool(((flights >= 0) & (flights < len(self.pool))).all())

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins flights.

        Args:
            seed: of the first environment, those of others follow; or one for each.
            options: `reset_mask` (N,) of the environments to reset, all by default; for their next
                flight `flight`, a number in the pool or one for each, `start` and `goal` (3) [m].
        """
        options = options or {}
        points = require_options(options, "reset_mask", "flight")
        mask = np.ones(self.num_envs, bool)
        if "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            valid = mask.shape == (self.num_envs,) and mask.dtype == bool and mask.any()
            condition = f"({self.num_envs},) bool with a True"
            require(valid, "reset_mask", condition, f"{mask.dtype} of {mask.shape}")
        self._seed(seed, mask)
        rows = np.flatnonzero(mask)
        flights = None
        if "flight" in options:
            flights = np.asarray(options["flight"])
            valid = flights.shape in ((), rows.shape) and flights.dtype.kind in "iu"
            condition = f"one or {len(rows)} in [0, {len(self.pool)})"
            require(valid and self._in_pool(flights), "flight", condition, flights.tolist())
            flights = np.broadcast_to(flights, rows.shape)
        self._begun[rows] = False  # also if this fails
        self._begin(rows, flights, points)
        self._begun[rows] = True
        return self._observe_again(rows), self._drawn(mask)

    def _drawn(self, mask: NDArray[np.bool_]) -> dict[str, Any]:
        """Returns infos of the present flights of the environments in a mask (N,)."""
        pool = self.pool
        drawn = {
            "scenario": pool.scenario,
            "world_seed": pool.world_seeds,
            "flight_seed": pool.seeds,
        }
        infos = {name: np.where(mask, each[self._flight], 0) for name, each in drawn.items()}
        return infos | {f"_{name}": mask.copy() for name in infos}

    def _seed(self, seed: int | Sequence[int | None] | None, mask: NDArray[np.bool_]) -> None:
        seeds: list[int | None] = [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seeds = [int(seed) + i for i in range(self.num_envs)]
        elif seed is not None:
            seeds = list(seed)
            condition = f"a number, or {self.num_envs} numbers"
            require(len(seeds) == self.num_envs, "seed", condition, f"{len(seeds)} numbers")
        for i in np.flatnonzero(mask):
            given = seeds[i]
            if given is None and not self._begun[i]:
                given = int(self.np_random.integers(MAX_SEED))
            if given is not None:
                self._seeds[i], self._episodes[i] = given, 0

    def _begin(
        self,
        rows: NDArray[np.intp],
        flights: NDArray[np.intp] | None = None,
        points: dict[str, list[float]] | None = None,
    ) -> None:
        """Begins flights of the environments `rows`, drawn from the pool unless they are given;
        `points` moves their start or goal."""
        pool, arrays, points = self.pool, self._arrays, points or {}
        if flights is None:
            drawn = _hash(_hash(self._seeds[rows]) + self._episodes[rows])
            flights = self._choices[(drawn % np.uint64(len(self._choices))).astype(int)]
        self._episodes[rows] += np.uint64(1)
        self._flight[rows] = flights
        arrays.parameters[rows // PACK, :, rows % PACK] = pool.parameters[flights]
        for name, values in pool.starts.items():
            getattr(arrays, name)[rows] = values[flights]
        self._previous[rows], self._count[rows] = 0.0, 0
        for row, flight in zip(rows, flights, strict=True) if points else ():
            world = pool.worlds[pool.world[flight]]
            scenario = replace(pool.scenarios[flight], **points)
            scenario.validate()
            arrays.states[row] = sample_initial_state(scenario, world)
            arrays.goals[row] = goal_position(scenario, world)
            arrays.distances[row] = world.distance_field.distance(arrays.states[row, :3])
        arrays.ends[rows], self._ended[rows] = 0, False
        if pool.is_delayed:  # Until the first action has come, that of zeros counts.
            zeros = self._previous[rows]
            self._decisions[rows] = decisions(self.config, zeros, arrays.states[rows])

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Flies for one period of the policy with actions (N, n) in [-1, 1]."""
        config = self.config
        given = require_actions(actions, self._previous.shape)
        resting = self._ended.copy()
        late = ~self._begun
        if self._mode is not AutoresetMode.NEXT_STEP:
            late |= resting
        if late.any():
            ended = np.flatnonzero(late).tolist()
            raise ResetNeeded(f"flights must be begun by reset() before step(), got {ended}")
        if resting.any():
            self._begin(np.flatnonzero(resting))
        flying = ~resting
        # Copies by columns, which are several times faster to compute with.
        arrays = self._arrays
        before, p_WG = (np.array(each, order="F") for each in (arrays.states, arrays.goals))
        decided = np.ascontiguousarray(decisions(config, given, before))
        if self.pool.is_delayed:
            self._delays[:] = self.pool.delays[self._flight, self._count % CYCLE]
        self._threads.advance(
            self.pool.native,
            arrays.native,
            kind=config.action,
            actions=decided,
            earlier=self._decisions,
            delays=self._delays,
            flying=flying,
            actuated=self.pool.actuated,
            **self._steps,
        )
        ends = arrays.ends
        ended, reached = ends > 0, ends == _GOAL
        truncated = ends == _TIMEOUT
        terminated = ended ^ truncated
        transition = Transition(
            states=before,
            next_states=np.array(arrays.states, order="F"),
            p_WG=p_WG,
            distances=arrays.distances.copy(),
            actions=given,
            previous_actions=self._previous.copy(),
            reached=reached,
            failed=terminated ^ reached,
            duration=self.time_step,
            radius=self.pool.radius,
        )
        rewards = np.array(config.reward(transition), dtype=float)
        valid = rewards.shape == (self.num_envs,)
        require(valid, "shape of the rewards", f"({self.num_envs},)", rewards.shape)
        if resting.any():
            rewards = np.where(flying, rewards, 0.0)
        own = config.terminates(transition) & flying & ~ended
        ends[own] = _TERMINATED
        ended, terminated = ended | own, terminated | own
        self._previous[flying] = given[flying]
        self._ended = ended.copy()
        if self.pool.is_delayed:
            np.copyto(self._decisions, decided, where=flying[:, None])
        self._count += flying
        infos: dict[str, Any] = {}
        if ended.any():
            infos = {"outcome": _OUTCOMES[ends], "is_success": reached}
            infos |= {f"_{name}": ended.copy() for name in infos} | self._drawn(ended)
            if self._mode is AutoresetMode.SAME_STEP:
                rows = np.flatnonzero(ended)
                last, final = self._observe(rows), np.full(self.num_envs, None, dtype=object)
                for k, row in enumerate(rows):
                    is_dict = isinstance(last, dict)
                    final[row] = {name: v[k] for name, v in last.items()} if is_dict else last[k]
                self._begin(rows)
                infos = {"final_obs": final, "final_info": infos}
                infos |= {f"_{name}": ended.copy() for name in infos} | self._drawn(ended)
        if resting.any():
            infos |= self._drawn(resting | ended)
        observed = self._observe()
        if self._mode is AutoresetMode.DISABLED:
            self._last = deepcopy(observed)
        return observed, rewards, terminated, truncated, infos

    def _observe_again(self, rows: NDArray[np.intp]) -> Any:
        """Returns the observations of all environments, where `rows` have changed."""
        if self._mode is not AutoresetMode.DISABLED or self._last is None:
            return self._observe()
        part = self._observe(rows)
        if isinstance(part, dict):
            for name, values in part.items():
                self._last[name][rows] = values
        else:
            self._last[rows] = part
        return deepcopy(self._last)

    def _observe(self, rows: NDArray[np.intp] | slice = slice(None)) -> Any:
        """Returns the observations of environments, in new arrays."""
        names, arrays = self.config.observation_names(), self._arrays
        states, p_WG = (np.array(each[rows], order="F") for each in (arrays.states, arrays.goals))
        vehicles = Vehicles(states, p_WG, arrays.distances[rows], np.zeros_like(p_WG))
        if "obstacle" in names:
            distances, gradients = query(self.pool.native, states, arrays.world[rows])
            vehicles = vehicles._replace(distances=distances, gradients=gradients)
        observed: dict[str, Any] = {
            name: np.ascontiguousarray(values) for name, values in observe(names, vehicles).items()
        }
        ports = {IMAGES[name] for name in names if name in IMAGES}
        if ports:
            images = self._render(rows, ports)
            for name in names:
                if name in IMAGES:
                    max_depth = self.config.camera.max_depth
                    observed[name] = observe_image(name, images[IMAGES[name]], max_depth)
        return self.config.arrange(observed)

    def _render(self, rows: NDArray[np.intp] | slice, ports: set[str]) -> dict[str, NDArray]:
        """Renders images of the policy's camera, by the ports of `SplatCamera`."""
        camera = self.config.camera
        views, backgrounds = self._views(camera.camera_info(), camera.mount(), rows)
        options: dict[str, Any] = {
            "distortion": camera.distortion,
            "max_depth": camera.max_depth,
            "merged_spread": camera.merged_spread,
            "backgrounds": backgrounds,
        }
        images = {}  # In two passes: each leaves out what only the other needs.
        if "depth_image_32f" in ports:
            depth = self._renderer.render_depth(*views, **options)
            images["depth_image_32f"] = ranged_depth(depth, camera.min_depth, camera.max_depth)
        if "color_image" in ports:
            images["color_image"] = color_pixels(self._renderer.render_color(*views, **options))
        return images

    def _views(
        self, info: CameraInfo, X_BC: RigidTransform, rows: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[tuple[Any, ...], list[Background]]:
        """Returns scenes and views of a camera of each vehicle, and the backgrounds."""
        worlds = [self.pool.worlds[w] for w in self.pool.world[self._flight[rows]]]
        X_WCs = [pose_from_state(state) @ X_BC for state in self._arrays.states[rows]]
        camera = info.intrinsic_matrix(), info.width(), info.height(), X_WCs
        return ([w.baked for w in worlds], *camera), [w.background for w in worlds]

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns images (H, W, 3) of the scenario's camera, one of each vehicle."""
        if self.render_mode is None:
            return None
        if not self._begun.all():
            raise ResetNeeded("flights must be begun by reset() before render()")
        config = self.config.scenario.camera
        views, backgrounds = self._views(camera_info(config), camera_mount(config))
        return tuple(color_pixels(self._renderer.render_color(*views, backgrounds=backgrounds)))


def _hash(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mixes the bits of numbers, as SplitMix64 does (Steele, Lea and Flood, OOPSLA 2014)."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
