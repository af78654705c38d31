"""Vehicles as they were when the image was taken that was the last to come, in torch.

The twin of `splatpilot.systems.sensing.delayed_pose.DelayedPose` and of its `FrameTimes`, whose
samples are the steps of the policy.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.systems.sensing.frame_times import CYCLE, lookback
from splatpilot.systems.sensing.observation_noise import ObservationNoise
from splatpilot.training.policies.vehicles import Vehicle


class Frames(NamedTuple):
    """When the images of N vehicles are taken and come, as `FrameTimes` has it."""

    delays: Tensor  # (N, CYCLE) [s], or (N, 1) where images are taken when somebody looks
    rate: Tensor  # (N,) [Hz]
    phase: Tensor  # (N,) [-]


def draw_frames(noise: ObservationNoise, count: int, generator: torch.Generator) -> Frames:
    """Those of `count` flights."""
    device = generator.device

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, device=device)

    if not noise.frame_rate:
        zero = torch.zeros(count, device=device)
        return Frames(torch.full((count, 1), noise.latency, device=device), zero, zero)
    lower, upper = noise.frame_rate
    rate, phase = lower + (upper - lower) * uniform(count), uniform(count)
    late, lost = uniform(count, CYCLE), uniform(count, CYCLE)
    delays = noise.latency + noise.jitter * late
    return Frames(torch.where(lost < noise.frame_dropout, torch.inf, delays), rate, phase)


def frame_ages(frames: Frames, noise: ObservationNoise, time: Tensor) -> Tensor:
    """The ages (N,) [s], at times (N,) [s], of the last images that have come."""
    delays, rate, phase = frames
    if delays.shape[1] == 1:
        return delays[:, 0]
    back = torch.arange(lookback(noise), device=time.device)
    number = (time * rate - phase).floor()[:, None] - back  # newest first
    ages = time[:, None] - (number + phase[:, None]) / rate[:, None]
    came = delays.gather(1, number.long() % CYCLE) <= ages
    came[:, -1] = True
    return ages.gather(1, came.int().argmax(1, keepdim=True))[:, 0]


def remembered[V: Vehicle](vehicle: V, noise: ObservationNoise, rate: float) -> V:
    """The past of N vehicles that have none: its tensors (N, K, ...) hold the last K states at
    `rate` [Hz], as far back as images are old, oldest first, and before there are so many the
    earliest known."""
    oldest = lookback(noise) / noise.frame_rate[0] if noise.frame_rate else noise.latency
    samples = math.ceil(oldest * rate) + 1

    def fill(x: Tensor) -> Tensor:
        return torch.stack([x.detach()] * samples, 1)

    return type(vehicle)(*map(fill, vehicle))


def remember[V: Vehicle](past: V, vehicle: V) -> V:
    """The past (N, K, ...) with what the vehicles are now, and without the oldest state."""

    def push(old: Tensor, now: Tensor) -> Tensor:
        return torch.cat([old[:, 1:], now.detach()[:, None]], 1)

    return type(vehicle)(*map(push, past, vehicle))


def delayed[V: Vehicle](past: V, ages: Tensor, rate: float) -> V:
    """The N vehicles `ages` (N,) [s] before the newest of their past (N, K, ...) at `rate` [Hz],
    without gradient: between samples the state is interpolated linearly, as in flight."""
    everyone, last = torch.arange(len(ages), device=ages.device), past[0].shape[1] - 1
    at = (last - ages * rate).clamp(min=0.0)
    before = at.long()
    after, part = (before + 1).clamp(max=last), at - before

    def interpolate(x: Tensor) -> Tensor:
        weight = part.reshape(-1, *[1] * (x.dim() - 2)).to(x.dtype)
        return torch.lerp(x[everyone, before], x[everyone, after], weight)

    return type(past)(*map(interpolate, past))
