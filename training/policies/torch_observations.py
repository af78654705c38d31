"""What depth policies are told, in torch; see `systems.policies.observation` for each formula."""

from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.systems.policies.velocity import MAX_ACCELERATION, RESPONSE_TIME
from splatpilot.systems.sensing.time_of_flight import LEAST_DEPTH
from splatpilot.training.policies.vehicles import Vehicle


class Observation(NamedTuple):
    """What N vehicles know at one transition."""

    depth: Tensor  # (N, R) [m], planar, inf beyond
    vehicle: Vehicle
    p_WG: Tensor  # (N, 3) [m]
    speed: Tensor  # (N,) [m/s], asked for


def inverse_depth(depth: Tensor, nearest: float, farthest: float) -> Tensor:
    """Planar depth (...,) [m] as 3 / z - 0.6, z within [nearest, farthest]."""
    return 3.0 / depth.clamp(nearest, farthest) - 0.6


def proximity_grid(
    depth: Tensor, range_of_depth: Tensor, max_range: float, height: int, width: int
) -> Tensor:
    """The proximities (N, height, width) in images of depth (N, R) [m], the lowest row first.

    See `splatpilot.systems.sensing.time_of_flight`, also for `range_of_depth` (H, W); H and W must
    be multiples of height and width.
    """
    H, W = range_of_depth.shape
    measured = torch.where(depth > LEAST_DEPTH, depth, max_range).reshape(-1, H, W)
    blocks = (measured * range_of_depth).reshape(-1, height, H // height, width, W // width)
    return (1.0 - blocks.amin((2, 4)).clamp(0.0, max_range) / max_range).flip(1)


def target_velocity(p: Tensor, p_WG: Tensor, speed: Tensor, slowing_time: float = 1.0) -> Tensor:
    """The velocities (N, 3) [m/s] from p (N, 3) straight to p_WG (N, 3) [m], at `speed` (N,) [m/s]
    until `slowing_time` [s] before it."""
    to_goal = p_WG - p
    distance = to_goal.square().sum(1, keepdim=True).clamp(min=1e-6).sqrt()
    return to_goal / (distance / speed[:, None]).clamp(min=slowing_time)


def heading_frame(yaw: Tensor) -> Tensor:
    """R_WH (N, 3, 3) of vehicles that head for `yaw` (N,) [rad]: about z alone."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], 1).reshape(-1, 3, 3)


def heading_observation(seen: Observation, R_WH: Tensor) -> Tensor:
    """(N, 9) target velocity, velocity and the body's z axis in the heading frame."""
    v_target = target_velocity(seen.vehicle.p, seen.p_WG, seen.speed)
    rows = torch.stack([v_target, seen.vehicle.v, seen.vehicle.body_z()], 1)
    return (rows @ R_WH).flatten(1)


def tracking_acceleration(v: Tensor, v_wanted: Tensor) -> Tensor:
    """The accelerations (N, 3) [m/s^2] with which velocities (N, 3) [m/s] approach those wanted;
    see `splatpilot.systems.policies.velocity`."""
    a = (v_wanted - v) / RESPONSE_TIME
    size = a.square().sum(1, keepdim=True).clamp(min=1e-12).sqrt()
    return a * (MAX_ACCELERATION / size).clamp(max=1.0)


def limit_smoothly(output: Tensor, limits: Tensor) -> Tensor:
    """Outputs (N, D) of a network within +-limits (D,), smoothly."""
    return limits * torch.tanh(output / limits)
