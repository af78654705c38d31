"""Flights of a policy through worlds, many at once: how well it does."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.policies.image_noise import noisy_depth
from splatpilot.training.policies.ray_casting import Geometry, PixelRays
from splatpilot.training.policies.training_worlds import WorldBatch
from splatpilot.training.policies.vehicles import (
    BodyRate,
    Frames,
    Observation,
    PointMass,
    Vehicle,
    delayed,
    draw_frames,
    frame_ages,
    remember,
    remembered,
)

CAMERA_AHEAD = 0.1
"""[m], of the camera before the vehicle's centre, along body x."""


class Agent(Protocol):
    """What observes through a camera and decides, for N vehicles at once."""

    rate: float  # [Hz]
    rays: PixelRays

    def initial_memory(self, count: int) -> Tensor:
        """What N vehicles remember at first, (N, ...)."""
        ...

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        """Accelerations (N, 3) [m/s^2] in W, headings (N,) [rad] or None, and the memory after."""
        ...


@torch.no_grad()
def render_depth(vehicle: Vehicle, geometry: Geometry, rays: PixelRays, world: Tensor) -> Tensor:
    """Depth (N, R) [m] from the vehicles' cameras, each in its `world` (N,)."""
    x, y, z = vehicle.attitude().unbind(2)
    R_WC = torch.stack([-y, -z, x], 2)
    return geometry.depth(vehicle.p + CAMERA_AHEAD * x, R_WC, rays, world)


class Outcomes(NamedTuple):
    """How N flights went."""

    reached: Tensor  # (N,) bool
    collided: Tensor  # (N,) bool
    left: Tensor  # (N,) bool, the volume
    least_clearance: Tensor  # (N,) [m]
    mean_speed: Tensor  # (N,) [m/s]
    wanted_speed: Tensor  # (N,) [m/s]

    def measures(self, kinds: list[str] | None = None) -> dict[str, float]:
        """Parts of the flights that reached the goal, collided and left; what remains took too
        long. Means of least clearance [m] and speed [m/s]. Success is also given for each speed
        that was wanted and, flight n being of kind n modulo their number, each of `kinds`."""
        flown: dict[str, list[bool]] = {}
        flights = zip(self.reached.tolist(), self.wanted_speed.tolist(), strict=True)
        for n, (reached, speed) in enumerate(flights):
            for name in [f"{speed:g} m/s", *([kinds[n % len(kinds)]] if kinds else [])]:
                flown.setdefault(name, []).append(reached)
        return {
            "success": float(self.reached.float().mean()),
            "collisions": float(self.collided.float().mean()),
            "left": float(self.left.float().mean()),
            "least_clearance": float(self.least_clearance.mean()),
            "speed": float(self.mean_speed.mean()),
            **{name: sum(flown[name]) / len(flown[name]) for name in sorted(flown)},
        }


@dataclass
class FlightConditions:
    """Of the flights that measure a policy."""

    # [m/s] Asked of the policy, each in as many worlds, drawn at random.
    speeds: list[float] = field(default_factory=lambda: [2.0, 3.0, 4.0])
    # [m] The goal is reached within this distance.
    goal_radius: float = 0.3
    # [-] Flights end after this multiple of the time that the straight way takes at that speed.
    patience: float = 2.5
    # [s] Lag of the acceleration of point masses.
    lag: float = 0.12
    # Whether the body-rate quadrotor flies, instead of a point mass.
    body_rate: bool = False

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        validate_speeds(self.speeds, "validation.speeds")


def validate_speeds(speeds: Sequence[float], name: str) -> None:
    """Raises ValueError unless all are speeds that can be asked for."""
    if not speeds or not all(0.1 <= speed <= 10.0 for speed in speeds):
        raise ValueError(f"{name} is {speeds}; give one or more of 0.1 to 10 m/s")


@torch.no_grad()
def evaluate_agent(
    agent: Agent,
    worlds: WorldBatch,
    conditions: FlightConditions,
    noise: ObservationNoise,
    seed: int = 0,
) -> Outcomes:
    """Flies every world once from its start, at rest, level and facing the goal; the images are
    disturbed and late as `noise` says."""
    device = worlds.p_WS.device
    generator = torch.Generator(device).manual_seed(seed)
    count = len(worlds)
    p_WG, to_goal = worlds.p_WG, worlds.p_WG - worlds.p_WS
    yaw = torch.atan2(to_goal[:, 1], to_goal[:, 0])
    zero = torch.zeros_like(p_WG)
    if conditions.body_rate:
        vehicle: Vehicle = BodyRate.hovering(worlds.p_WS, yaw)
    else:
        lag = torch.full((count, 1), conditions.lag, device=device)
        vehicle = PointMass(worlds.p_WS, zero, zero, yaw, lag)
    memory, control = agent.initial_memory(count), FlatnessControllerConfig()
    shuffled = torch.randperm(count, generator=generator, device=device)
    speed = torch.tensor(conditions.speeds, device=device)[shuffled % len(conditions.speeds)]
    past = remembered(vehicle, noise, agent.rate)
    frames = draw_frames(noise, count, generator)

    reached, collided, left = (torch.zeros(count, dtype=torch.bool, device=device) for _ in "rcl")
    clearance = torch.full((count,), torch.inf, device=device)
    path, time = torch.zeros(count, device=device), torch.zeros(count, device=device)
    flying = torch.arange(count, device=device)
    limit = conditions.patience * to_goal.norm(dim=1) / speed
    dt = 1.0 / agent.rate
    while len(flying):
        distances, _ = worlds.geometry.nearest(vehicle.p, flying, 1)
        here = distances[:, 0] - VEHICLE_RADIUS
        clearance[flying] = torch.minimum(clearance[flying], here)
        inside = (vehicle.p > worlds.lower_W[flying]) & (vehicle.p < worlds.upper_W[flying])
        collided[flying] = here < 0.0
        left[flying] = ~inside.all(1) & ~collided[flying]
        done = (vehicle.p - p_WG[flying]).norm(dim=1) < conditions.goal_radius
        reached[flying] = done & ~collided[flying] & ~left[flying]
        ended = (reached | collided | left | (time > limit))[flying]
        if ended.any():
            keep = (~ended).nonzero()[:, 0]
            flying, memory = flying[keep], memory[keep]
            vehicle, past = (type(vehicle)(*(x[keep] for x in of)) for of in (vehicle, past))
            frames = Frames(*(x[keep] for x in frames))
            continue
        past = remember(past, vehicle)
        then = delayed(past, frame_ages(frames, noise, time[flying]), agent.rate)
        depth = render_depth(then, worlds.geometry, agent.rays, flying)
        depth = noisy_depth(depth, noise, generator)
        seen = Observation(depth, vehicle, p_WG[flying], speed[flying])
        a_cmd, heading, memory = agent.decide(seen, memory)
        before = vehicle.p
        vehicle = vehicle.step(a_cmd, dt, control, heading)
        path[flying] += (vehicle.p - before).norm(dim=1)
        time[flying] += dt
    return Outcomes(reached, collided, left, clearance, path / time.clamp(min=dt), speed)
