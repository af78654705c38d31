"""Rollouts of many vehicles at once: flights that evaluate a policy, and losses that are
differentiated through the dynamics of flight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from splatpilot.systems.common.provenance import first_training_seed
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.policies.augmentation import check_noise, depth_noise, noisy_depth
from splatpilot.training.policies.ray_casting import Geometry, PixelRays
from splatpilot.training.policies.trainer import Trainer, TrainingConfig
from splatpilot.training.policies.training_worlds import (
    STARTS,
    WorldBatch,
    WorldSelection,
    training_worlds,
    validation_worlds,
)
from splatpilot.training.policies.vehicles import (
    BodyRate,
    History,
    Observation,
    PointMass,
    Vehicle,
    camera_poses,
    choose_rows,
    map_tensors,
)


class Agent(Protocol):
    """A policy that flies N vehicles at once by a camera."""

    rate: float  # [Hz]
    rays: PixelRays

    def initial_memory(self, count: int) -> Tensor:
        """Returns the hidden states (N, ...) of N vehicles at their start."""
        ...

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        """Computes a_WB (N, 3) [m/s^2], headings (N,) [rad] or None, and the next hidden states."""
        ...


@torch.no_grad()
def render_depth(vehicle: Vehicle, geometry: Geometry, rays: PixelRays, world: Tensor) -> Tensor:
    """Renders depth (N, R) [m] from the vehicles' cameras, each in its `world` (N,)."""
    return geometry.depth(*camera_poses(vehicle), rays, world)


class Outcomes(NamedTuple):
    """Outcomes of N flights."""

    reached: Tensor  # (N,) bool
    collided: Tensor  # (N,) bool
    left: Tensor  # (N,) bool, the volume
    min_clearance: Tensor  # (N,) [m]
    mean_speed: Tensor  # (N,) [m/s]
    nominal_speed: Tensor  # (N,) [m/s]

    def metrics(self, kinds: Sequence[str] = ()) -> dict[str, float]:
        """Computes fractions of flights that reached the goal, collided and left; means; and the
        success at each nominal speed and in each of the `kinds` of worlds, which take turns."""
        flown: dict[str, list[bool]] = {}
        flights = zip(self.reached.tolist(), self.nominal_speed.tolist(), strict=True)
        for n, (reached, speed) in enumerate(flights):
            for name in [f"{speed:g} m/s", *([kinds[n % len(kinds)]] if kinds else [])]:
                flown.setdefault(name, []).append(reached)
        return {
            "success": float(self.reached.float().mean()),
            "collisions": float(self.collided.float().mean()),
            "left": float(self.left.float().mean()),
            "least_clearance": float(self.min_clearance.mean()),
            "speed": float(self.mean_speed.mean()),
            **{name: sum(flown[name]) / len(flown[name]) for name in sorted(flown)},
        }


@dataclass
class FlightConditions(Config):
    """Conditions of flights that evaluate a policy."""

    # [m/s] Nominal speeds, each in as many worlds, drawn at random.
    speeds: list[float] = bounded(lambda: [2.0, 3.0, 4.0], "[0.1, 10] m/s")
    # [m] The goal is reached within this distance.
    goal_radius: float = 0.3
    # [-] Maximum time of flights, in times of the straight line at the nominal speed.
    patience: float = 2.5
    # [s] Lag of the acceleration of point masses.
    lag: float = 0.12
    # Flies the body-rate quadrotor instead of a point mass.
    body_rate: bool = False

    def check(self) -> None:
        require_field(self, "speeds", self.speeds, "one speed or more")


@torch.no_grad()
def evaluate_agent(
    agent: Agent,
    worlds: WorldBatch,
    conditions: FlightConditions,
    noise: ObservationNoise,
    seed: int = 0,
) -> Outcomes:
    """Flies through every world once, from rest, facing the goal, with noisy and late images."""
    device = worlds.p_WS.device
    generator = torch.Generator(device).manual_seed(seed)
    count = len(worlds)
    p_WG, to_goal = worlds.p_WG, worlds.p_WG - worlds.p_WS
    yaw = torch.atan2(to_goal[:, 1], to_goal[:, 0])
    zero = torch.zeros_like(p_WG)
    lag = torch.full((count, 1), conditions.lag, device=device)
    vehicle: Vehicle = PointMass(worlds.p_WS, zero, zero, yaw, lag)
    if conditions.body_rate:
        vehicle = BodyRate.hovering(worlds.p_WS, yaw)
    memory = agent.initial_memory(count)
    shuffled = torch.randperm(count, generator=generator, device=device)
    speed = torch.tensor(conditions.speeds, device=device)[shuffled % len(conditions.speeds)]
    history = History.start(vehicle, noise, agent.rate, generator)

    reached, collided, left = (torch.zeros(count, dtype=torch.bool, device=device) for _ in "rcl")
    clearance = torch.full((count,), torch.inf, device=device)
    path, time = torch.zeros(count, device=device), torch.zeros(count, device=device)
    flying = torch.arange(count, device=device)
    limit = conditions.patience * to_goal.norm(dim=1) / speed
    dt = 1.0 / agent.rate
    while len(flying):
        here, inside = worlds.clearance(vehicle.p, flying)
        clearance[flying] = torch.minimum(clearance[flying], here)
        collided[flying] = here < 0.0
        left[flying] = ~inside & ~collided[flying]
        done = (vehicle.p - p_WG[flying]).norm(dim=1) < conditions.goal_radius
        reached[flying] = done & ~collided[flying] & ~left[flying]
        ended = (reached | collided | left | (time > limit))[flying]
        if ended.any():
            keep = (~ended).nonzero()[:, 0]
            flying, memory = flying[keep], memory[keep]
            vehicle, history = map_tensors(itemgetter(keep), (vehicle, history))
            continue
        history = history.push(vehicle)
        past = history.seen(noise, agent.rate, time[flying])
        depth = render_depth(past, worlds.geometry, agent.rays, flying)
        depth = noisy_depth(depth, noise, generator)
        color = worlds.color(past, flying)
        seen = Observation(depth, vehicle, p_WG[flying], speed[flying], color)
        a_cmd, heading, memory = agent.decide(seen, memory)
        before = vehicle.p
        vehicle = vehicle.step(a_cmd, dt, heading)
        path[flying] += (vehicle.p - before).norm(dim=1)
        time[flying] += dt
    return Outcomes(reached, collided, left, clearance, path / time.clamp(min=dt), speed)


@dataclass
class FlightTraining(TrainingConfig):
    """Fields of trainers that fly in training worlds."""

    worlds: WorldSelection = field(default_factory=WorldSelection)
    # Conditions of the flights that select among checkpoints.
    validation: FlightConditions = field(default_factory=FlightConditions)

    def check(self) -> None:
        first_training_seed(self.seed)


class FlightTrainer(Trainer):
    """Base class of trainers that fly, evaluated in held-out worlds; `noise` is of images."""

    def __init__(self, config: FlightTraining, agent: Any, noise: ObservationNoise) -> None:
        self.network, self.spec = agent.network, agent.network.spec
        self.agent, self.noise, self.conditions = agent, noise, config.validation
        self.generator = torch.Generator(config.device).manual_seed(config.seed)
        self.worlds = training_worlds(config.worlds, config.seed, config.device)
        self._validation = validation_worlds(config.worlds, config.device)
        self._kinds, self.learns_from = config.worlds.turns, config.worlds.digest()

    def evaluate(self) -> dict[str, float]:
        outcomes = evaluate_agent(self.agent, self._validation, self.conditions, self.noise)
        return outcomes.metrics(self._kinds)


NUM_OBSTACLES = 4  # number of nearest obstacles in the loss of each step


class Transitions(NamedTuple):
    """M steps of vehicles, as they are after each, in W and with gradients."""

    v_mean: Tensor  # (M, 3) [m/s], moving average of v_WB
    v_target: Tensor  # (M, 3) [m/s], along the path to the goal
    a: Tensor  # (M, 3) [m/s^2]
    jerk: Tensor  # (M, 3) [m/s^3]
    # (M, K) [m], beyond the vehicle's radius, of the nearest obstacles and last the volume's top
    clearance: Tensor
    approach: Tensor  # (M, K) [m/s], velocity toward them
    heading: Tensor | None  # (M,) [rad], commanded

    def losses(self, weights: Any, **terms: Tensor) -> dict[str, Tensor]:
        """Computes the weighted means, in the order of the fields of `weights`, of terms (M,); of
        the smooth L1 error of the mean velocity; and of the squares of acceleration and jerk."""
        velocity = torch.nn.functional.smooth_l1_loss(self.v_mean, self.v_target, reduction="none")
        terms["velocity"] = velocity.sum(1)
        terms["acceleration"], terms["jerk"] = self.a.square().sum(1), self.jerk.square().sum(1)
        return {name: w * terms[name].mean() for name, w in vars(weights).items() if name in terms}


class Learner(Agent, Protocol):
    """An agent with a network and a loss."""

    network: Any  # torch.nn.Module with the `spec` of its architecture

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        """Computes the weighted terms of the loss, each a mean since the last call."""
        ...


@dataclass
class RolloutConfig(Config):
    """Flights of vehicles in training."""

    # [-] Vehicles in flight at once.
    environments: int = bounded(64, "[1, inf)")
    # [-] Steps of the policy that the loss is differentiated through.
    steps: int = bounded(32, "[1, inf)")
    # [m/s] Range of the vehicles' nominal speeds.
    speed: list[float] = bounded(lambda: [1.5, 4.0], "(0, inf) m/s")
    # [s] Range of the vehicles' lags of the acceleration.
    lag: list[float] = bounded(lambda: [0.07, 0.2], "(0, inf) s")
    # [-] Factor of gradients for each second that they go back.
    gradient_decay: float = bounded(0.4, "[0, 1]")
    # [s] Time constant of the moving average of the velocity.
    averaging: float = bounded(0.5, "(0, inf) s")
    # [s] Maximum time of flights.
    longest: float = bounded(15.0, "(0, inf) s")
    # Noise and delay of images.
    noise: ObservationNoise = field(default_factory=depth_noise)

    def check(self) -> None:
        for name in ("speed", "lag"):
            limits = getattr(self, name)
            valid = len(limits) == 2 and limits[0] <= limits[1]
            require_field(self, name, valid, "two numbers in ascending order")
        check_noise(self.noise, depth=True, time=True)


class Episodes(NamedTuple):
    """Flights of N vehicles, which continue from one update to the next."""

    vehicle: PointMass
    history: History
    world: Tensor  # (N,), indices of the worlds
    v_mean: Tensor  # (N, 3) [m/s]
    memory: Tensor  # (N, H)
    speed: Tensor  # (N,) [m/s]
    age: Tensor  # (N,) [s]


class DifferentiableRollout:
    """Episodes of flight in `worlds`, each in another world, from which `learner` learns."""

    def __init__(
        self,
        learner: Learner,
        worlds: WorldBatch,
        config: RolloutConfig,
        generator: torch.Generator,
    ) -> None:
        self.learner, self.worlds, self.config = learner, worlds, config
        self.generator = generator
        self.episodes = self._new_episodes()

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that the next losses depend on except the learner."""
        tensors: list[Tensor] = []
        map_tensors(lambda x: tensors.append(x) or x, self.episodes)
        return {"episodes": tensors, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the result of `state_dict`."""
        tensors = iter(state["episodes"])
        self.episodes = map_tensors(lambda _: next(tensors), self.episodes)
        self.generator.set_state(state["generator"])

    def _new_episodes(self) -> Episodes:
        """Begins episodes anywhere in any world, in flight roughly along the path to the goal."""
        config, N = self.config, self.config.environments
        uniform = partial(torch.rand, generator=self.generator, device=self.generator.device)

        def between(limits: list[float], *size: int) -> Tensor:
            return limits[0] + (limits[1] - limits[0]) * uniform(*size)

        def draw(count: int) -> Tensor:
            return (uniform(N) * count).long().clamp(max=count - 1)

        world = draw(len(self.worlds))
        p = self.worlds.starts_W[world, draw(STARTS)]
        speed = between(config.speed, N)
        direction = self.worlds.direction(p, world)
        v = direction * (speed * uniform(N))[:, None] + 0.3 * (uniform(N, 3) - 0.5)
        yaw = torch.atan2(direction[:, 1], direction[:, 0]) + 1.0 * (uniform(N) - 0.5)
        vehicle = PointMass(p, v, torch.zeros_like(p), yaw, between(config.lag, N, 1))
        return Episodes(
            vehicle,
            History.start(vehicle, config.noise, self.learner.rate, self.generator),
            world,
            v,
            self.learner.initial_memory(N),
            speed,
            uniform(N) * config.longest,
        )

    def _restart_ended(self, episodes: Episodes) -> Episodes:
        ended = self.worlds.ended(episodes.vehicle.p, episodes.world)
        ended |= episodes.age > self.config.longest
        new = self._new_episodes()
        return choose_rows(ended, new._replace(age=torch.zeros_like(new.age)), episodes)

    def losses(self) -> dict[str, Tensor]:
        """Flies `steps` further and computes the terms of the loss, differentiable."""
        config, learner, worlds = self.config, self.learner, self.worlds
        dt = 1.0 / learner.rate
        keep = config.gradient_decay**dt
        forget = 1.0 - math.exp(-dt / config.averaging)
        with torch.no_grad():
            episodes = self._restart_ended(self.episodes)
        vehicle, history, world, v_mean, memory, speed, age = episodes
        p_WG = worlds.p_WG[world]
        vehicles, v_means, headings = [vehicle], [], []
        for step in range(config.steps):
            history = history.push(vehicle)
            past = history.seen(config.noise, learner.rate, age + step * dt)
            depth = render_depth(past, worlds.geometry, learner.rays, world)
            depth = noisy_depth(depth, config.noise, self.generator)
            seen = Observation(depth, vehicle, p_WG, speed, worlds.color(past, world))
            a_cmd, heading, memory = learner.decide(seen, memory)
            vehicle = vehicle.decay_gradient(keep).step(a_cmd, dt, heading)
            v_mean = torch.lerp(v_mean, vehicle.v, forget)
            vehicles.append(vehicle)
            v_means.append(v_mean)
            if heading is not None:
                headings.append(heading)
        age = age + config.steps * dt
        episodes = Episodes(vehicle, history, world, v_mean, memory, speed, age)
        self.episodes = map_tensors(Tensor.detach, episodes)
        p, v = (torch.cat([getattr(step, name) for step in vehicles[1:]]) for name in "pv")
        a = torch.stack([step.a for step in vehicles])  # (steps + 1, N, 3)
        everyone = torch.arange(len(world), device=world.device).repeat(config.steps)
        world, p_WG, speed = world[everyone], p_WG[everyone], speed[everyone]
        distances, normals = worlds.geometry.nearest(p, world, NUM_OBSTACLES)
        # The value is the distance, and the gradient its normal.
        moved, approach = (normals @ torch.stack([p - p.detach(), -v], 2)).unbind(2)
        clearance = distances + moved - VEHICLE_RADIUS
        # Images of an open world do not show the top of the volume.
        below_top = worlds.upper_W[world, 2] - VEHICLE_RADIUS - p[:, 2]
        clearance = torch.cat([clearance, below_top[:, None]], 1)
        approach = torch.cat([approach, v[:, 2:]], 1)
        with torch.no_grad():
            slowed = torch.minimum(speed, (p_WG - p).norm(dim=1))
            v_target = worlds.direction(p, world) * slowed[:, None]
        transitions = Transitions(
            torch.cat(v_means),
            v_target,
            a[1:].flatten(0, 1),
            (a.diff(dim=0) / dt).flatten(0, 1),
            clearance,
            approach,
            torch.cat(headings) if headings else None,
        )
        return learner.losses(transitions)


@dataclass
class RolloutTraining(FlightTraining):
    """A training run by differentiable rollouts."""

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    # [-] Fraction of the updates, at first, in worlds without obstacles.
    empty: float = bounded(0.0, "[0, 1)")


class RolloutTrainer(FlightTrainer):
    """Trains a learner by the loss of rollouts."""

    def __init__(self, policy: str, learner: Learner, config: RolloutTraining) -> None:
        super().__init__(config, learner, config.rollout.noise)
        self.policy = policy
        self._first_update = round(config.empty * config.schedule.updates)
        batches = [self.worlds]
        if self._first_update:
            batches.append(self.worlds.without_obstacles())
        self._rollouts = [
            DifferentiableRollout(learner, worlds, config.rollout, self.generator)
            for worlds in batches
        ]
        self._current = self._rollouts[0]

    def begin_update(self, update: int) -> None:
        self._current = self._rollouts[int(update < self._first_update)]

    def losses(self) -> dict[str, Tensor]:
        return self._current.losses()

    def state_dict(self) -> dict[str, Any]:
        rollouts = [rollout.state_dict() for rollout in self._rollouts]
        return super().state_dict() | {"rollouts": rollouts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for rollout, saved in zip(self._rollouts, state["rollouts"], strict=True):
            rollout.load_state_dict(saved)
        super().load_state_dict(state)
