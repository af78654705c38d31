"""Observations, actions, rewards and configuration of the environments, for N vehicles.

The heading frame H has its origin in the vehicle, z up and x above the body's x axis.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray

from splatpilot.diagrams.flight.blocks import DECISIONS
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.distributions import is_distribution
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    require,
    require_field,
    unknown,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import GRAVITY, VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState


class Transition(NamedTuple):
    """One step of N vehicles.

    Args:
        states: (N, 13) true ones at its beginning, see `QuadrotorState`
        next_states: (N, 13) true ones at its end
        p_WG: (N, 3) [m], goals
        distances: (N,) [m] from p_WB at its end to the nearest surface, or NaN
        actions: (N, n) in [-1, 1], of the range of `action_limits`
        previous_actions: (N, n); zeros in the first step of a flight
        reached: (N,), the flight ended at the goal
        failed: (N,), the flight ended by a collision or outside of the world; not by `terminate`
        duration: [s]
        radius: [m] of the vehicle
    """

    states: NDArray[np.float64]
    next_states: NDArray[np.float64]
    p_WG: NDArray[np.float64]
    distances: NDArray[np.float64]
    actions: NDArray[np.float64]
    previous_actions: NDArray[np.float64]
    reached: NDArray[np.bool_]
    failed: NDArray[np.bool_]
    duration: float
    radius: float = VEHICLE_RADIUS


@dataclass
class Reward(Config):
    """Default reward (N,) of a `Transition`: the sum of terms, each times its weight."""

    # [1/m] Of progress: how much nearer the goal is than before.
    progress: float = bounded(1.0, "(-inf, inf) 1/m")
    # [1/(m s)] Of the barrier, the collision penalty of `soft_barrier`, over time.
    barrier: float = bounded(-0.5, "(-inf, inf) 1/(m s)")
    # [1/m] Sharpness of the barrier.
    beta: float = bounded(8.0, "(0, inf) 1/m")
    # [m] Clearance at which the barrier rises.
    margin: float = bounded(0.3, "(-inf, inf) m")
    # [-] Of smoothness: the mean square of the change of the action.
    smoothness: float = bounded(-0.02, "(-inf, inf)")
    # [1/s] Of time in flight.
    time: float = bounded(-0.2, "(-inf, inf) 1/s")
    # [-] Of the arrival at the goal.
    success: float = bounded(10.0, "(-inf, inf)")
    # [-] Of a collision, and of leaving the world.
    failure: float = bounded(-10.0, "(-inf, inf)")

    def terms(self, transition: Transition) -> dict[str, Any]:
        """Returns the terms (N,) by their names, times their weights."""
        t = transition
        before, after = (
            np.sqrt(((t.p_WG - states[..., :3]) ** 2).sum(-1))
            for states in (t.states, t.next_states)
        )
        barrier = soft_barrier(t.distances, t.radius, self.beta, self.margin)
        change = ((t.actions - t.previous_actions) ** 2).mean(-1)
        return {
            "progress": self.progress * (before - after),
            "barrier": self.barrier * t.duration * np.nan_to_num(barrier, nan=0.0),
            "smoothness": self.smoothness * change,
            "time": np.full(len(change), self.time * t.duration),
            "success": self.success * t.reached,
            "failure": self.failure * t.failed,
        }

    def __call__(self, transition: Transition) -> NDArray[np.float64]:
        """Returns the rewards (N,)."""
        return np.sum(list(self.terms(transition).values()), axis=0)


class Vehicles(NamedTuple):
    """N vehicles at one instant."""

    states: NDArray[np.float64]  # (N, 13), see `QuadrotorState`
    p_WG: NDArray[np.float64]  # (N, 3) [m], goals
    distances: NDArray[np.float64]  # (N,) [m] from p_WB to the nearest surface; NaN outside
    gradients: NDArray[np.float64]  # (N, 3) of the distances by p_WB, in W; zero outside


_SPEEDS, _RATES = [30.0] * 3, [20.0] * 3  # [m/s] and [rad/s] at which observations are clipped

# Bounds of observations that are vectors. Distances to goals end at 1 km.
_BOUNDS = {
    name: (-np.array(high), np.array(high))
    for name, high in {
        "state": [*_SPEEDS, *[1.0] * 3, *_RATES],
        "full_state": [*[1e3] * 3, *_SPEEDS, *[1.0] * 4, *_RATES],
        "goal": [*[1.0] * 3, 100.0],
        "obstacle": [*[1.0] * 3, 10.0],
    }.items()
}
_BOUNDS["goal"][0][3] = 0.0

IMAGES = {"depth": "depth_image_32f", "depth_m": "depth_image_32f", "rgb": "color_image"}
"""Observations that are images, and the port of the policy's camera that each needs."""

TERMINATED = "terminated"
"""Outcome of flights that end by `FlightEnvConfig.terminate`."""

OBSERVATIONS = (*_BOUNDS, *IMAGES)
"""Names of all observations besides the outputs of sensors."""


def observation_space(
    config: "FlightEnvConfig",
    sensors: Mapping[str, Space[Any]] | None = None,
    outputs: Collection[str] = (),
) -> Space[Any]:
    """Returns the space of one vehicle's observation: a Dict, or a Box if `observation` is a name.

    Args:
        sensors: spaces of the observed outputs of sensors by name, such as `imu_accelerometer`.
        outputs: names of all outputs of sensors, if they are known.
    """
    sensors = sensors or {}
    names = config.observation_names()
    for name in names:
        known = [*OBSERVATIONS, *outputs]
        others = "" if outputs else ", or in FlightEnv an output of the scenario's sensors"
        require(name in known, "observation", f"one of {', '.join(known)}{others}", repr(name))
    spaces = {name: sensors.get(name) or _space(name, config.camera) for name in names}
    return spaces[names[0]] if isinstance(config.observation, str) else Dict(spaces)


def _space(name: str, camera: OnboardCamera) -> Box:
    if name in _BOUNDS:
        low, high = (bound.astype(np.float32) for bound in _BOUNDS[name])
        return Box(low, high, dtype=np.float32)
    size = camera.height, camera.width
    if name == "depth_m":
        return Box(0.0, camera.max_depth, size, np.float32)
    return Box(0, 255, (*size, 3 if name == "rgb" else 1), np.uint8)


def observe(names: Sequence[str], vehicles: Vehicles) -> dict[str, NDArray[np.float32]]:
    """Returns the observations (N, n) that are vectors, of those named, within their bounds:

    - `state` (9): v_WB [m/s] and the body's z axis, both in H, and w_WB_B [rad/s];
    - `full_state` (13): that of `QuadrotorState`;
    - `goal` (4): the direction to the goal in H, and its distance [10 m];
    - `obstacle` (4): the direction away from the nearest surface in H, the gradient of the distance
      field, and the distance of p_WB to it [m]; zeros outside the world.
    """
    observed: dict[str, NDArray[np.float32]] = {}
    p_WB, v_WB, q_WB, w_WB_B = QuadrotorState.of(vehicles.states)
    heading = _heading(q_WB)
    for name in names:
        if name == "state":
            parts = [_to_heading(v_WB, *heading), _to_heading(_up(q_WB), *heading), w_WB_B]
        elif name == "full_state":
            parts = [vehicles.states]
        elif name == "goal":
            to_goal = vehicles.p_WG - p_WB
            distance = np.sqrt((to_goal * to_goal).sum(-1, keepdims=True))
            direction = to_goal / np.maximum(distance, 1e-9)
            parts = [_to_heading(direction, *heading), distance / 10.0]
        elif name == "obstacle":
            distance = np.nan_to_num(vehicles.distances, nan=0.0)[..., None]
            parts = [_to_heading(vehicles.gradients, *heading), distance]
        else:
            continue
        whole = np.concatenate(parts, axis=-1) if len(parts) > 1 else parts[0]
        observed[name] = np.clip(whole, *_BOUNDS[name]).astype(np.float32)
    return observed


def observe_image(name: str, image: NDArray[Any], max_depth: float) -> NDArray[Any]:
    """Returns an observation of `IMAGES`.

    - `depth` (..., H, W, 1) uint8: proximity, 255 (1 - z / `max_depth`) of planar depth z, and 0
      where nothing is seen;
    - `depth_m` (..., H, W) float32 [m]: planar depth, `max_depth` where nothing is seen;
    - `rgb` (..., H, W, 3) uint8.

    Args:
        image: (..., H, W) planar depth [m], 0 if too near and inf if too far; or (..., H, W, 3 or
            4) uint8.
    """
    if name == "rgb":
        return np.ascontiguousarray(image[..., :3])
    depth = np.minimum(image, np.float32(max_depth))
    if name == "depth_m":
        return depth
    proximity = np.float32(255.5) - depth * np.float32(255.0 / max_depth)
    return proximity.astype(np.uint8)[..., None]


# [-] Scale of actions at 1: body rates [rad/s], for thrust that is g; [m/s^2], [m/s], [m].
_LIMITS = {
    "command": (6.0, 6.0, 2.0),
    "acceleration": (6.0, 6.0, 6.0),
    "velocity": (3.0, 3.0, 3.0),
    "waypoint": (1.2, 1.2, 1.2),
}


def action_space(config: "FlightEnvConfig") -> Box:
    """Returns the space of one vehicle's action, [-1, 1] (n,) float32; see `decisions`."""
    return Box(-1.0, 1.0, (DECISIONS[config.action],), np.float32)


def require_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Returns actions as floats; raises ValueError unless all are in [-1, 1] and of this shape."""
    given = np.asarray(actions, dtype=float)
    require(given.shape == shape, "shape of action", str(shape), given.shape)
    outside = given[~(np.abs(given) <= 1.0)]  # NaN too
    first = next(iter(outside), np.nan)
    remedy = "" if np.isnan(first) else "clip actions, as gymnasium.wrappers.ClipAction does"
    require(not outside.size, "action", "in [-1, 1]", first, remedy)
    return given


def require_options(options: Mapping[str, Any], *others: str) -> dict[str, list[float]]:
    """Returns `start` and `goal` of a reset's options; raises ValueError for names besides these
    and `others`, and unless both are vectors."""
    known = *others, "start", "goal"
    for name in options:
        require(name in known, "options", f"of {', '.join(known)}", repr(name))
    points = {name: np.asarray(options[name]) for name in known[-2:] if name in options}
    for name, point in points.items():
        valid = point.ndim == 1 and point.dtype.kind in "iuf"
        require(valid, name, "three finite numbers x, y, z [m]", options[name])
    return {name: point.tolist() for name, point in points.items()}


def decisions(
    config: "FlightEnvConfig", actions: NDArray[np.float64], states: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Converts actions (N, n) in [-1, 1] to decisions (N, n) of `AddFlight`, in W, which one step
    holds; `config.limits()` is the scale:

    - `command`: thrust over mass g + limit a [m/s^2], and body rates [rad/s];
    - `acceleration` [m/s^2] and `velocity` [m/s]: in H at the beginning of the step;
    - `waypoint` [m]: relative to p_WB, in H at the beginning of the step.

    Args:
        states: (N, 13) at the beginning of the step.
    """
    scaled = actions * config.limits()
    if config.action == "command":
        scaled[..., 0] += config.gravity
        return scaled
    p_WB, _, q_WB, _ = QuadrotorState.of(states)
    cos, sin = _heading(q_WB)
    rotated = _to_heading(scaled, cos, -sin)
    return rotated + p_WB if config.action == "waypoint" else rotated


def _heading(q_WB: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns cosine and sine (N,) of headings, 1 and 0 if body x is vertical."""
    w, x, y, z = q_WB.T
    along, left = w * w + x * x - y * y - z * z, 2.0 * (w * z + x * y)
    length = np.sqrt(along * along + left * left)
    is_vertical = length < 1e-9
    length = length + is_vertical
    return np.where(is_vertical, 1.0, along / length), left / length


def _to_heading(
    vectors: NDArray[np.float64], cos: NDArray[np.float64], sin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotates vectors (N, 3) from W to H."""
    x, y, z = vectors.T
    return np.array([cos * x + sin * y, cos * y - sin * x, z]).T


def _up(q_WB: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the body's z axis (N, 3) in W."""
    w, x, y, z = q_WB.T
    up = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z])
    return (up / (w * w + x * x + y * y + z * z)).T


@dataclass
class FlightEnvConfig(Config):
    """Configuration of `FlightEnv` and `VectorFlightEnv`."""

    # World, vehicle, start, goal, timeout and noise; its policy is not used.
    scenario: Scenario = field(default_factory=Scenario)
    # Names of `OBSERVATIONS`, and outputs of the scenario's sensors; one name for a Box.
    observation: str | Sequence[str] = ("state", "goal")
    # Decision of the policy, see `decisions`.
    action: str = bounded("velocity", "{command, acceleration, velocity, waypoint}")
    # [Hz] Steps per second; a step is a whole number of the controller's periods.
    rate: float = bounded(10.0, "(0, 1000] Hz")
    # Scale of the components of actions; if empty ±g and 6, 6, 2 rad/s for commands, 6 m/s^2, 3 m/s
    # and 1.2 m.
    action_limits: list[float] = bounded(list, "(0, inf)")
    # Camera of the images.
    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(max_depth=12.0, merged_spread=1.0)
    )
    # From transitions of N vehicles to their rewards (N,).
    reward: Callable[[Transition], NDArray[np.float64]] = field(default_factory=Reward)
    # From transitions of N vehicles to the flights (N,) that end, besides those of `AddFlight`.
    terminate: Callable[[Transition], NDArray[np.bool_]] | None = None
    # Number of worlds among which resets draw, of the seeds from that of the scenario on.
    num_worlds: int = bounded(1, "[1, 1000000]")

    __hash__: ClassVar[None] = None  # pyright: ignore

    def check(self) -> None:
        size = DECISIONS[self.action]
        limits = self.action_limits
        valid = len(limits) in (0, size) and np.isfinite(limits).all()
        require_field(self, "action_limits", valid, f"{size} finite numbers, or empty")
        if limits and self.action == "command":
            condition = f"at most {self.gravity} m/s^2, as the thrust must not be negative"
            require_field(self, "action_limits", limits[0] <= self.gravity, condition)
        steps = 1.0 / (self.rate * self.scenario.controller.period)
        valid = steps > 0.5 and abs(steps - round(steps)) < 1e-6
        condition = f"{1.0 / self.scenario.controller.period:g} Hz, the controller's, over a whole "
        require_field(self, "rate", valid, f"{condition}number")
        names = self.observation_names()
        valid = names and len(set(names)) == len(names)
        require_field(self, "observation", valid, "different names, at least one")
        require_field(self, "reward", callable(self.reward), "a function of a Transition")
        valid = self.terminate is None or callable(self.terminate)
        require_field(self, "terminate", valid, "a function of a Transition, or None")

    @property
    def gravity(self) -> float:
        """Acceleration of gravity [m/s^2]; Earth's, if it differs from flight to flight."""
        gravity = self.scenario.vehicle.gravity
        return GRAVITY if is_distribution(gravity) else gravity

    def observation_names(self) -> list[str]:
        """Returns the names of the observations."""
        return [self.observation] if isinstance(self.observation, str) else list(self.observation)

    def arrange(self, observed: Mapping[str, Any]) -> Any:
        """Returns observations by name as the space has them: in its order, or the only one."""
        if isinstance(self.observation, str):
            return observed[self.observation]
        return {name: observed[name] for name in self.observation}

    def limits(self) -> NDArray[np.float64]:
        """Returns the scale (n,) of actions."""
        thrust = (self.gravity,) if self.action == "command" else ()
        return np.array(self.action_limits or (*thrust, *_LIMITS[self.action]))

    def terminates(self, transition: Transition) -> NDArray[np.bool_]:
        """Returns the flights (N,) that end by `terminate`."""
        count = len(transition.actions)
        if self.terminate is None:
            return np.zeros(count, bool)
        ends = np.asarray(self.terminate(transition))
        found = f"{ends.dtype} of {ends.shape}"
        valid = ends.shape == (count,) and ends.dtype == bool
        require(valid, "the result of terminate", f"bool of ({count},)", found)
        return ends


def find_scenario(scenario: Scenario | str | Path) -> Scenario:
    """Returns a scenario, given as such, by the name of one that ships, or by a YAML file."""
    if isinstance(scenario, Scenario):
        return scenario
    return load_config(Scenario(), scenario_file(str(scenario)))


def env_config(
    scenario: Scenario | str | Path, world: World | None = None, **arguments: Any
) -> FlightEnvConfig:
    """Returns the valid configuration of an environment of a scenario, see `find_scenario`."""
    num_worlds = arguments.get("num_worlds", 1)
    require(world is None or num_worlds == 1, "num_worlds", "1 with a world", num_worlds)
    known = [each.name for each in fields(FlightEnvConfig)[1:]]
    for name in (each for each in arguments if each not in known):
        of_scenario = f"fields of scenario, as {name}" if hasattr(Scenario(), name) else ""
        raise ValueError(unknown("argument", name, known, of_scenario))
    config = FlightEnvConfig(find_scenario(scenario), **arguments)
    config.validate()
    return config
