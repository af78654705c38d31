"""Rollouts of many vehicles whose loss is differentiated through the dynamics of flight."""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from splatpilot.systems.common.seeds import first_training_seed
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.policies.evaluation import (
    Agent,
    FlightConditions,
    evaluate_agent,
    render_depth,
)
from splatpilot.training.policies.image_noise import (
    noisy_depth,
    training_noise,
    validate_training_noise,
)
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.ray_casting import Geometry
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.training_worlds import (
    STARTS,
    WorldBatch,
    WorldSelection,
    training_worlds,
    validation_worlds,
)
from splatpilot.training.policies.vehicles import (
    Frames,
    Observation,
    PointMass,
    choose_rows,
    delayed,
    draw_frames,
    frame_ages,
    remember,
    remembered,
    where_rows,
)

NEAREST = 4
"""Obstacles that the loss looks at, the nearest ones at each step."""


class Transitions(NamedTuple):
    """What a loss is made of: M steps of vehicles and what they are after each, everything in W and
    with gradients."""

    v_mean: Tensor  # (M, 3) [m/s], moving average of v_WB
    v_target: Tensor  # (M, 3) [m/s], along the way to the goal
    a: Tensor  # (M, 3) [m/s^2]
    jerk: Tensor  # (M, 3) [m/s^3]
    # (M, K) [m], beyond the vehicle's radius, of the nearest obstacles and last the volume's lid
    clearance: Tensor
    approach: Tensor  # (M, K) [m/s], velocity towards them
    heading: Tensor | None  # (M,) [rad], asked for


class Learner(Agent, Protocol):
    """An agent that learns: its network, and what it wants."""

    network: TrainableNetwork

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        """The weighted terms of the loss, by name, each a mean over the transitions."""
        ...


@dataclass
class RolloutConfig:
    """How vehicles fly while they learn."""

    # [-] Vehicles in flight at once.
    environments: int = 64
    # [-] Steps of the policy that the loss is differentiated through at once.
    steps: int = 32
    # [m/s] Range that each vehicle's wanted speed is drawn from.
    speed: list[float] = field(default_factory=lambda: [1.5, 4.0])
    # [s] Range that each vehicle's lag of the acceleration is drawn from.
    lag: list[float] = field(default_factory=lambda: [0.07, 0.2])
    # [-] What is left of a gradient that went back through a second of flight.
    gradient_decay: float = 0.4
    # [s] Time constant of the moving average of the velocity.
    averaging: float = 0.5
    # [s] A flight ends after this time, wherever it is.
    longest: float = 15.0
    # What the images are disturbed by, and how late they are.
    noise: ObservationNoise = field(default_factory=training_noise)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("environments", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"rollout.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("speed", "lag"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 0.0 < limits[0] <= limits[1] < float("inf"):
                raise ValueError(
                    f"rollout.{name} is {limits}; it must be two positive numbers, the lesser first"
                )
        validate_training_noise(
            self.noise, "rollout.noise", of_depth=True, of_colors=False, of_time=True
        )
        if not 0.0 <= self.gradient_decay <= 1.0:
            raise ValueError(
                f"rollout.gradient_decay is {self.gradient_decay}; it must be between 0 and 1"
            )
        for name in ("averaging", "longest"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ValueError(f"rollout.{name} is {getattr(self, name)} s; it must be positive")


class Episodes(NamedTuple):
    """The flights of N vehicles, which go on from one update to the next."""

    vehicle: PointMass
    past: PointMass  # (N, K, ...), see `remembered`
    frames: Frames
    world: Tensor  # (N,), numbers of the worlds flown in
    v_mean: Tensor  # (N, 3) [m/s]
    memory: Tensor  # (N, H)
    speed: Tensor  # (N,) [m/s]
    age: Tensor  # (N,) [s]


class DifferentiableRollout:
    """Episodes of flight in `worlds`, each in a world drawn anew, from which `learner` learns."""

    def __init__(
        self,
        learner: Learner,
        worlds: WorldBatch,
        config: RolloutConfig,
        generator: torch.Generator,
    ) -> None:
        self.learner, self.worlds, self.config = learner, worlds, config
        self.generator = generator
        self._control = FlatnessControllerConfig()
        self.episodes = self._new_episodes()

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next losses depend on but the learner."""
        vehicle, past, frames, *others = self.episodes
        episodes = [*vehicle, *past, *frames, *others]
        return {"episodes": episodes, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The inverse of `state_dict`."""
        saved, count = state["episodes"], len(PointMass._fields)
        vehicle, past = PointMass(*saved[:count]), PointMass(*saved[count : 2 * count])
        others = saved[2 * count :]
        frames = Frames(*others[: len(Frames._fields)])
        self.episodes = Episodes(vehicle, past, frames, *others[len(Frames._fields) :])
        self.generator.set_state(state["generator"])

    def _uniform(self, *size: int) -> Tensor:
        return torch.rand(*size, generator=self.generator, device=self.generator.device)

    def _new_episodes(self) -> Episodes:
        """New episodes, anywhere in any world, in flight towards about where the way leads."""
        config, N = self.config, self.config.environments

        def between(limits: list[float], *size: int) -> Tensor:
            return limits[0] + (limits[1] - limits[0]) * self._uniform(*size)

        def draw(count: int) -> Tensor:
            return (self._uniform(N) * count).long().clamp(max=count - 1)

        world = draw(len(self.worlds))
        p = self.worlds.starts_W[world, draw(STARTS)]
        speed = between(config.speed, N)
        way = self.worlds.way(p, world)
        v = way * (speed * self._uniform(N))[:, None] + 0.3 * (self._uniform(N, 3) - 0.5)
        yaw = torch.atan2(way[:, 1], way[:, 0]) + 1.0 * (self._uniform(N) - 0.5)
        vehicle = PointMass(p, v, torch.zeros_like(p), yaw, between(config.lag, N, 1))
        return Episodes(
            vehicle,
            remembered(vehicle, config.noise, self.learner.rate),
            draw_frames(config.noise, N, self.generator),
            world,
            v,
            self.learner.initial_memory(N),
            speed,
            self._uniform(N) * config.longest,
        )

    def _restart_ended(self, episodes: Episodes) -> Episodes:
        """Episodes that have ended begin anew."""
        worlds, world, p = self.worlds, episodes.world, episodes.vehicle.p
        clearance = worlds.geometry.nearest(p, world, 1)[0][:, 0] - VEHICLE_RADIUS
        inside = (p > worlds.lower_W[world]) & (p < worlds.upper_W[world])
        ended = (
            (clearance < 0.0)
            | ~inside.all(1)
            | ((p - worlds.p_WG[world]).norm(dim=1) < 0.5)
            | (episodes.age > self.config.longest)
        )
        fresh = self._new_episodes()
        fresh = fresh._replace(age=torch.zeros_like(fresh.age))

        vehicle = choose_rows(ended, fresh.vehicle, episodes.vehicle)
        past = choose_rows(ended, fresh.past, episodes.past)
        frames = Frames(*map(partial(where_rows, ended), fresh.frames, episodes.frames))
        others = zip(fresh[3:], episodes[3:], strict=True)
        return Episodes(vehicle, past, frames, *(where_rows(ended, a, b) for a, b in others))

    def losses(self) -> dict[str, Tensor]:
        """Flies on for `steps` and returns the terms of the loss, differentiable."""
        config, learner, worlds = self.config, self.learner, self.worlds
        dt = 1.0 / learner.rate
        keep = config.gradient_decay**dt
        forget = 1.0 - math.exp(-dt / config.averaging)
        with torch.no_grad():
            episodes = self._restart_ended(self.episodes)
        vehicle, past, frames, world, v_mean, memory, speed, age = episodes
        p_WG = worlds.p_WG[world]
        vehicles, v_means, headings = [vehicle], [], []
        for step in range(config.steps):
            past = remember(past, vehicle)
            ages = frame_ages(frames, config.noise, age + step * dt)
            then = delayed(past, ages, learner.rate)
            depth = render_depth(then, worlds.geometry, learner.rays, world)
            depth = noisy_depth(depth, config.noise, self.generator)
            a_cmd, heading, memory = learner.decide(
                Observation(depth, vehicle, p_WG, speed), memory
            )
            vehicle = vehicle.decay_gradient(keep).step(a_cmd, dt, self._control, heading)
            v_mean = torch.lerp(v_mean, vehicle.v, forget)
            vehicles.append(vehicle)
            v_means.append(v_mean)
            if heading is not None:
                headings.append(heading)
        self.episodes = Episodes(
            vehicle.detach(),
            past,
            frames,
            world,
            v_mean.detach(),
            memory.detach(),
            speed,
            age + config.steps * dt,
        )
        p, v = (torch.cat([getattr(step, name) for step in vehicles[1:]]) for name in "pv")
        a = torch.stack([step.a for step in vehicles])  # (steps + 1, N, 3)
        everyone = torch.arange(len(world), device=world.device).repeat(config.steps)
        world, p_WG, speed = world[everyone], p_WG[everyone], speed[everyone]
        clearance, approach = _obstacles(worlds.geometry, p, v, world)
        # Vehicles keep clear of the lid of the volume, which images of an open world do not show.
        under_lid = worlds.upper_W[world, 2] - VEHICLE_RADIUS - p[:, 2]
        clearance = torch.cat([clearance, under_lid[:, None]], 1)
        approach = torch.cat([approach, v[:, 2:]], 1)
        with torch.no_grad():
            v_target = worlds.way(p, world) * torch.minimum(speed, (p_WG - p).norm(dim=1))[:, None]
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


def _obstacles(geometry: Geometry, p: Tensor, v: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
    """Clearance (M, K) [m] and velocity of approach (M, K) [m/s] of the nearest obstacles of
    vehicles at p (M, 3) [m] with velocities v (M, 3) [m/s] in `world` (M,)."""
    distances, normals = geometry.nearest(p, world, NEAREST)
    # The value is the distance, and the gradient its normal.
    moved, approach = (normals @ torch.stack([p - p.detach(), -v], 2)).unbind(2)
    return distances + moved - VEHICLE_RADIUS, approach


@dataclass
class RolloutTraining:
    """A training run by differentiable rollouts."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    schedule: Schedule = field(default_factory=Schedule)
    worlds: WorldSelection = field(default_factory=WorldSelection)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    # How the flights are that choose among checkpoints.
    validation: FlightConditions = field(default_factory=FlightConditions)
    # [-] Part of the updates, at first, that are flown in worlds without obstacles.
    empty: float = 0.0

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        first_training_seed(self.seed)
        self.schedule.validate()
        self.worlds.validate()
        self.rollout.validate()
        self.validation.validate()
        if not 0.0 <= self.empty < 1.0:
            raise ValueError(f"empty is {self.empty}; it must be at least 0 and less than 1")


class RolloutTrainer:
    """The `Trainer` of a learner: the loss of rollouts, and the success in held-out worlds."""

    def __init__(self, policy: str, learner: Learner, config: RolloutTraining) -> None:
        self.policy = policy
        self.network, self.spec = learner.network, learner.network.spec
        self._learner, self._config = learner, config
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        worlds = training_worlds(config.worlds, config.seed, config.device)
        self._validation = validation_worlds(config.worlds, config.device)
        self._main = self._rollout(worlds)
        self._first_update = round(config.empty * config.schedule.updates)
        self._empty = self._rollout(worlds.without_obstacles()) if self._first_update else None
        self._current = self._main

    def _rollout(self, worlds: WorldBatch) -> DifferentiableRollout:
        return DifferentiableRollout(self._learner, worlds, self._config.rollout, self._generator)

    def begin_update(self, update: int) -> None:
        early = self._empty is not None and update < self._first_update
        self._current = self._empty if early and self._empty is not None else self._main

    def losses(self) -> dict[str, Tensor]:
        return self._current.losses()

    def evaluate(self) -> dict[str, float]:
        config = self._config
        return evaluate_agent(
            self._learner, self._validation, config.validation, config.rollout.noise
        ).measures(config.worlds.turns)

    def state_dict(self) -> dict[str, Any]:
        rollouts = [rollout for rollout in (self._main, self._empty) if rollout is not None]
        return {
            "rollouts": [rollout.state_dict() for rollout in rollouts],
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        rollouts = [rollout for rollout in (self._main, self._empty) if rollout is not None]
        for rollout, saved in zip(rollouts, state["rollouts"], strict=True):
            rollout.load_state_dict(saved)
        self._generator.set_state(state["generator"])
