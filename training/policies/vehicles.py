"""Batches of vehicles for training: differentiable dynamics, and delayed images.

`PointMass` follows accelerations with a lag, and its heading the motion. `BodyRate` has the
equations of `QuadrotorPlant` with `FlatnessController`.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from splatpilot.systems.sensing.latency import CYCLE, frame_ages, frame_delays, lookback
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import (
    FlatnessControllerConfig,
    attitude_from_thrust,
    flatness_command,
    heading_along_motion,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, rk4_step
from splatpilot.systems.vehicle.state import QuadrotorState, rotation_matrices, unit_vectors

_CONTROL = FlatnessControllerConfig()
_SUBSTEP = 0.02  # [s], at most, of integration and control


class PointMass(NamedTuple):
    """N point masses with yaw."""

    p: Tensor  # (N, 3) [m], p_WB
    v: Tensor  # (N, 3) [m/s], v_WB
    a: Tensor  # (N, 3) [m/s^2], a_WB
    yaw: Tensor  # (N,) [rad], without gradient
    lag: Tensor  # (N, 1) [s], time constant of the acceleration

    def attitude(self) -> Tensor:
        """Computes R_WB (N, 3, 3): z along the thrust of this acceleration, x along the yaw."""
        return attitude_from_thrust(self._thrust(), self.yaw)

    def body_z(self) -> Tensor:
        """Computes the z axes (N, 3) of the body in W."""
        return unit_vectors(self._thrust())

    def _thrust(self) -> Tensor:
        params = QuadrotorParams()
        thrust = torch.add(self.a, self.v, alpha=params.drag)
        return thrust + torch.tensor([0.0, 0.0, params.gravity], device=thrust.device)

    def step(self, a_cmd: Tensor, dt: float, heading: Tensor | None = None) -> "PointMass":
        """Computes the state after `dt` [s] of commanded accelerations (N, 3) [m/s^2], exact for
        da/dt = (a_cmd - a) / lag, turning toward `heading` (N,) [rad] or along the velocity."""
        decay = torch.exp(-dt / self.lag)
        behind = self.a - a_cmd
        # Fused operations: with few vehicles, their number determines the time.
        coasting = self.lag * (1.0 - decay)  # (N, 1) [s]
        v = torch.addcmul(torch.add(self.v, a_cmd, alpha=dt), coasting, behind)
        p = torch.add(torch.add(self.p, self.v, alpha=dt), a_cmd, alpha=0.5 * dt**2)
        p = torch.addcmul(p, self.lag * (dt - coasting), behind)
        with torch.no_grad():
            along, strength = heading_along_motion(v, _CONTROL.yaw_speed)
            if heading is not None:
                along, strength = heading, torch.ones_like(strength)
            error = torch.remainder(along - self.yaw + torch.pi, 2 * torch.pi) - torch.pi
            rate, limit = _CONTROL.yaw_gain * strength * error, _CONTROL.max_yaw_rate
            yaw = self.yaw + dt * rate.clamp(-limit, limit)
        return PointMass(p, v, torch.addcmul(a_cmd, decay, behind), yaw, self.lag)

    def decay_gradient(self, factor: float) -> "PointMass":
        """Multiplies the gradient of the state by `factor` in the backward pass."""
        p, v, a = (torch.lerp(x.detach(), x, factor) for x in (self.p, self.v, self.a))
        return self._replace(p=p, v=v, a=a)


class BodyRate(NamedTuple):
    """N body-rate quadrotors under the law of `FlatnessController`."""

    state: Tensor  # (N, 13)
    a: Tensor  # (N, 3) [m/s^2], a_WB over the last substep

    @classmethod
    def hovering(cls, p_WB: Tensor, yaw: Tensor) -> "BodyRate":
        state = torch.zeros(len(p_WB), 13, device=p_WB.device)
        parts = QuadrotorState.of(state)
        parts.p_WB[:] = p_WB
        parts.q_WB[:, 0], parts.q_WB[:, 3] = torch.cos(yaw / 2), torch.sin(yaw / 2)
        return cls(state, torch.zeros_like(p_WB))

    @property
    def p(self) -> Tensor:
        return QuadrotorState.of(self.state).p_WB

    @property
    def v(self) -> Tensor:
        return QuadrotorState.of(self.state).v_WB

    @property
    def yaw(self) -> Tensor:
        R_WB = self.attitude()
        return torch.atan2(R_WB[:, 1, 0], R_WB[:, 0, 0])

    def attitude(self) -> Tensor:
        """Computes R_WB (N, 3, 3)."""
        return rotation_matrices(QuadrotorState.of(self.state).q_WB)

    def body_z(self) -> Tensor:
        """Computes the z axes (N, 3) of the body in W."""
        return self.attitude()[:, :, 2]

    def step(self, a_cmd: Tensor, dt: float, heading: Tensor | None = None) -> "BodyRate":
        """Computes the state after `dt` [s]: RK4 and new commands every 0.02 s or less."""
        params = QuadrotorParams()
        count = int(-(-dt // _SUBSTEP))
        state, before = self.state, self.state
        for _ in range(count):
            before = state
            v_WB = QuadrotorState.of(state).v_WB
            command = flatness_command(state, a_cmd, v_WB, heading, _CONTROL, params)
            state = rk4_step(state, command, params, dt / count)
        change = QuadrotorState.of(state).v_WB - QuadrotorState.of(before).v_WB
        return BodyRate(state, change * (count / dt))


Vehicle = PointMass | BodyRate

CAMERA_AHEAD = 0.1  # [m] offset of the camera from the vehicle's center along body x


def camera_poses(vehicle: Vehicle) -> tuple[Tensor, Tensor]:
    """Computes p_WC (N, 3) [m] and R_WC (N, 3, 3) of the vehicles' cameras."""
    x, y, z = vehicle.attitude().unbind(2)
    return vehicle.p + CAMERA_AHEAD * x, torch.stack([-y, -z, x], 2)


class Observation(NamedTuple):
    """Inputs of a policy for N vehicles at one step."""

    depth: Tensor  # (N, R) [m], planar, inf beyond
    vehicle: Vehicle
    p_WG: Tensor  # (N, 3) [m]
    speed: Tensor  # (N,) [m/s], nominal
    color: Tensor | None = None  # (N, H, W, 3), uint8, if the worlds have `views`


def map_tensors(function: Callable[..., Tensor], first: Any, *others: Any) -> Any:
    """Applies a function to the tensors of nested tuples of one type."""
    if isinstance(first, Tensor):
        return function(first, *others)
    mapped = [map_tensors(function, *part) for part in zip(first, *others, strict=True)]
    return type(first)(*mapped) if hasattr(first, "_fields") else tuple(mapped)


def choose_rows(chosen: Tensor, these: Any, others: Any) -> Any:
    """Takes rows of `these` tensors (N, ...) where `chosen` (N,), and of the others elsewhere."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(chosen.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    return map_tensors(choose, these, others)


class History(NamedTuple):
    """The last states of N vehicles and times of images, as by `DelayedPose`, sampled by steps."""

    past: Any  # vehicles with tensors (N, K, ...), oldest first, without gradient
    delays: Tensor  # (N, CYCLE) [s], or (N, 1) of images that are taken at each step
    frame_rate: Tensor  # (N,) [Hz]
    phase: Tensor  # (N,) [-]

    @classmethod
    def start(
        cls, vehicle: Vehicle, noise: ObservationNoise, rate: float, generator: torch.Generator
    ) -> Self:
        """Begins flights at `rate` [Hz], with states for the maximum age of images."""
        count, device = len(vehicle.p), generator.device
        uniform = partial(torch.rand, generator=generator, device=device)
        if noise.frame_rate:
            lower, upper = noise.frame_rate
            oldest = lookback(noise) / lower
            frame_rate, phase = lower + (upper - lower) * uniform(count), uniform(count)
            delays = frame_delays(noise, uniform(count, CYCLE), uniform(count, CYCLE))
        else:
            oldest, frame_rate = noise.latency, torch.zeros(count, device=device)
            delays, phase = torch.full((count, 1), oldest, device=device), frame_rate
        samples = math.ceil(oldest * rate) + 1
        past = map_tensors(lambda x: torch.stack([x.detach()] * samples, 1), vehicle)
        return cls(past, delays, frame_rate, phase)

    def push(self, vehicle: Vehicle) -> Self:
        """Adds the current states and drops the oldest."""

        def push(old: Tensor, now: Tensor) -> Tensor:
            return torch.cat([old[:, 1:], now.detach()[:, None]], 1)

        return self._replace(past=map_tensors(push, self.past, vehicle))

    def ages(self, noise: ObservationNoise, time: Tensor) -> Tensor:
        """Computes the ages (N,) [s], at times (N,) [s], of the last images that arrived."""
        if not noise.frame_rate:
            return self.delays[:, 0]
        return frame_ages(self.delays, self.frame_rate, self.phase, lookback(noise), time)

    def seen(self, noise: ObservationNoise, rate: float, time: Tensor) -> Any:
        """Interpolates the vehicles at the exposure of the last images at times (N,) [s]."""
        ages = self.ages(noise, time)
        rows, last = torch.arange(len(ages), device=ages.device), self.past[0].shape[1] - 1
        at = (last - ages * rate).clamp(min=0.0)
        before = at.long()
        after, part = (before + 1).clamp(max=last), at - before

        def interpolate(x: Tensor) -> Tensor:
            weight = part.reshape(-1, *[1] * (x.dim() - 2)).to(x.dtype)
            return torch.lerp(x[rows, before], x[rows, after], weight)

        return map_tensors(interpolate, self.past)
