"""Evaluation: flights of a policy in many worlds at once."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from splatpilot.systems.common.provenance import first_training_seed
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.policies.augmentation import noisy_depth
from splatpilot.training.policies.ray_casting import Geometry, PixelRays
from splatpilot.training.policies.trainer import Trainer, TrainingConfig
from splatpilot.training.policies.training_worlds import (
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
    map_tensors,
)

CAMERA_AHEAD = 0.1  # [m] offset of the camera from the vehicle's center along body x


class Agent(Protocol):
    """A policy that flies N vehicles at once by a camera."""

    rate: float  # [Hz]
    rays: PixelRays

    def initial_memory(self, count: int) -> Tensor:
        """Returns the hidden states (N, ...) of N vehicles at their start."""
        ...

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        """Computes accelerations (N, 3) [m/s^2] in W, headings (N,) [rad] or None, and the next
        hidden states."""
        ...


def camera_poses(vehicle: Vehicle) -> tuple[Tensor, Tensor]:
    """Computes p_WC (N, 3) [m] and R_WC (N, 3, 3) of the vehicles' cameras."""
    x, y, z = vehicle.attitude().unbind(2)
    return vehicle.p + CAMERA_AHEAD * x, torch.stack([-y, -z, x], 2)


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
        """Computes fractions of flights that reached the goal, collided and left, means of minimum
        clearance [m] and speed [m/s], and the success at each nominal speed and in each of the
        `kinds` of worlds, which take turns."""
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
    """Flies through every world once, from rest at its start, level and facing the goal, with noisy
    and late images."""
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
    """Base class of trainers that fly in training worlds, evaluated by flights in held-out ones.
    The agent has a `network`; `noise` is of images."""

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
