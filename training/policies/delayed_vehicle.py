"""Vehicles as they were when the image that arrives now was taken, in torch.

The twin of `splatpilot.systems.sensing.delayed_pose.DelayedPose`, whose samples are the steps of
the policy. A latency is counted in these steps: it is the product of the latency and their rate.
"""

import math

import torch
from torch import Tensor

from splatpilot.training.policies.vehicles import Vehicle


def remembered[V: Vehicle](vehicle: V, latency: float) -> V:
    """The past of N vehicles that have none: its tensors (N, K, ...) hold the last K states, oldest
    first, and before there are so many the earliest known."""
    samples = math.ceil(latency) + 1

    def fill(x: Tensor) -> Tensor:
        return torch.stack([x.detach()] * samples, 1)

    return type(vehicle)(*map(fill, vehicle))


def remember[V: Vehicle](past: V, vehicle: V) -> V:
    """The past (N, K, ...) with what the vehicles are now, and without the oldest state."""

    def push(old: Tensor, now: Tensor) -> Tensor:
        return torch.cat([old[:, 1:], now.detach()[:, None]], 1)

    return type(vehicle)(*map(push, past, vehicle))


def delayed[V: Vehicle](past: V, latency: float) -> V:
    """The N vehicles `latency` steps before the newest of their past (N, K, ...), without gradient:
    between samples the state is interpolated linearly, as in flight."""
    part = math.ceil(latency) - latency

    def interpolate(x: Tensor) -> Tensor:
        return x[:, 0] if part == 0.0 else torch.lerp(x[:, 0], x[:, 1], part)

    return type(past)(*map(interpolate, past))
