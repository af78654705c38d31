"""Rollouts of many vehicles whose loss is differentiated through the dynamics of flight."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.policies.augmentation import check_noise, depth_noise, noisy_depth
from splatpilot.training.policies.evaluation import (
    Agent,
    FlightTrainer,
    FlightTraining,
    render_depth,
)
from splatpilot.training.policies.training_worlds import STARTS, WorldBatch
from splatpilot.training.policies.vehicles import (
    History,
    Observation,
    PointMass,
    choose_rows,
    map_tensors,
)

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


class Learner(Agent, Protocol):
    """An agent with a network and a loss."""

    network: Any  # torch.nn.Module with the `spec` of its architecture

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        """Computes the weighted terms of the loss, each a mean over the transitions since the last
        call."""
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

    def _uniform(self, *size: int) -> Tensor:
        return torch.rand(*size, generator=self.generator, device=self.generator.device)

    def _new_episodes(self) -> Episodes:
        """Begins episodes anywhere in any world, in flight roughly along the path to the goal."""
        config, N = self.config, self.config.environments

        def between(limits: list[float], *size: int) -> Tensor:
            return limits[0] + (limits[1] - limits[0]) * self._uniform(*size)

        def draw(count: int) -> Tensor:
            return (self._uniform(N) * count).long().clamp(max=count - 1)

        world = draw(len(self.worlds))
        p = self.worlds.starts_W[world, draw(STARTS)]
        speed = between(config.speed, N)
        direction = self.worlds.direction(p, world)
        v = direction * (speed * self._uniform(N))[:, None] + 0.3 * (self._uniform(N, 3) - 0.5)
        yaw = torch.atan2(direction[:, 1], direction[:, 0]) + 1.0 * (self._uniform(N) - 0.5)
        vehicle = PointMass(p, v, torch.zeros_like(p), yaw, between(config.lag, N, 1))
        return Episodes(
            vehicle,
            History.start(vehicle, config.noise, self.learner.rate, self.generator),
            world,
            v,
            self.learner.initial_memory(N),
            speed,
            self._uniform(N) * config.longest,
        )

    def _restart_ended(self, episodes: Episodes) -> Episodes:
        worlds, world, p = self.worlds, episodes.world, episodes.vehicle.p
        clearance, inside = worlds.clearance(p, world)
        arrived = (p - worlds.p_WG[world]).norm(dim=1) < 0.5
        ended = (clearance < 0.0) | ~inside | arrived | (episodes.age > self.config.longest)
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
