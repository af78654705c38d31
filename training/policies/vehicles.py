"""Many vehicles in flight at once, differentiable, in torch.

`PointMass` follows accelerations with a lag and turns its nose along its motion, which is what
`FlatnessController` makes of the body-rate quadrotor: cheap enough to learn through. `BodyRate` is
that quadrotor, with the very equations of the simulated plant
(`systems.vehicle.quadrotor_dynamics`), under the controller's own law: what it does beyond the
point mass tells what the latter leaves out.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.systems.sensing.latency import CYCLE, lookback
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import (
    FlatnessControllerConfig,
    attitude_from_thrust,
    flatness_command,
    heading_along_motion,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, rk4_step
from splatpilot.systems.vehicle.state import QuadrotorState, rotation_matrices, unit_vectors

_SUBSTEP = 0.02  # [s], at most, of integration and control


class PointMass(NamedTuple):
    """N point masses with a yaw."""

    p: Tensor  # (N, 3) [m], p_WB
    v: Tensor  # (N, 3) [m/s], v_WB
    a: Tensor  # (N, 3) [m/s^2], a_WB
    yaw: Tensor  # (N,) [rad], without gradient
    lag: Tensor  # (N, 1) [s], time constant of the acceleration

    def attitude(self) -> Tensor:
        """R_WB (N, 3, 3): z along the thrust that this acceleration takes, x where yaw points."""
        return attitude_from_thrust(self._thrust(), self.yaw)

    def body_z(self) -> Tensor:
        """The z axes (N, 3) of the body in W."""
        return unit_vectors(self._thrust())

    def _thrust(self) -> Tensor:
        params = QuadrotorParams()
        thrust = torch.add(self.a, self.v, alpha=params.drag)
        return thrust + _up(thrust, params.gravity)

    def step(
        self,
        a_cmd: Tensor,
        dt: float,
        control: FlatnessControllerConfig,
        heading: Tensor | None = None,
    ) -> "PointMass":
        """The state after `dt` [s] under constant commanded accelerations (N, 3) [m/s^2].

        Exact for da/dt = (a_cmd - a) / lag. The nose turns towards `heading` (N,) [rad], or along
        the velocity, as under the controller.
        """
        decay = torch.exp(-dt / self.lag)
        behind = self.a - a_cmd
        # Sums with a factor are one operation: for so few vehicles their number is what costs.
        coasting = self.lag * (1.0 - decay)  # (N, 1) [s]
        v = torch.addcmul(torch.add(self.v, a_cmd, alpha=dt), coasting, behind)
        p = torch.add(torch.add(self.p, self.v, alpha=dt), a_cmd, alpha=0.5 * dt**2)
        p = torch.addcmul(p, self.lag * (dt - coasting), behind)
        with torch.no_grad():
            yaw = self.yaw + dt * yaw_rate(self.yaw, v, control, heading)
        return PointMass(p, v, torch.addcmul(a_cmd, decay, behind), yaw, self.lag)

    def decay_gradient(self, factor: float) -> "PointMass":
        """The same state, its gradient multiplied by `factor` on the way back."""
        return self._replace(
            p=_decay_gradient(self.p, factor),
            v=_decay_gradient(self.v, factor),
            a=_decay_gradient(self.a, factor),
        )

    def detach(self) -> "PointMass":
        return PointMass(*(x.detach() for x in self))


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
        """R_WB (N, 3, 3)."""
        return rotation_matrices(QuadrotorState.of(self.state).q_WB)

    def body_z(self) -> Tensor:
        """The z axes (N, 3) of the body in W."""
        return self.attitude()[:, :, 2]

    def step(
        self,
        a_cmd: Tensor,
        dt: float,
        control: FlatnessControllerConfig,
        heading: Tensor | None = None,
    ) -> "BodyRate":
        """The state after `dt` [s]: RK4 and new commands every 0.02 s or a little less."""
        params = QuadrotorParams()
        count = int(-(-dt // _SUBSTEP))
        state, before = self.state, self.state
        for _ in range(count):
            before = state
            v_WB = QuadrotorState.of(state).v_WB
            command = flatness_command(state, a_cmd, v_WB, heading, control, params)
            state = rk4_step(state, command, params, dt / count)
        change = QuadrotorState.of(state).v_WB - QuadrotorState.of(before).v_WB
        return BodyRate(state, change * (count / dt))


Vehicle = PointMass | BodyRate


class Observation(NamedTuple):
    """Inputs of a policy for N vehicles at one step."""

    depth: Tensor  # (N, R) [m], planar, inf beyond
    vehicle: Vehicle
    p_WG: Tensor  # (N, 3) [m]
    speed: Tensor  # (N,) [m/s], nominal


def reaching_acceleration(p_WR: Tensor, vehicle: Vehicle) -> Tensor:
    """The acceleration (N, 3) [m/s^2] that leads to p_WR (N, 3) in the lookahead."""
    T = FlatnessControllerConfig.lookahead
    return 2.0 * (p_WR - vehicle.p - T * vehicle.v) / T**2


def choose_rows[V: Vehicle](chosen: Tensor, these: V, others: V) -> V:
    """The rows of `these` vehicles where `chosen` (N,), those of the others elsewhere."""
    return type(these)(*(where_rows(chosen, a, b) for a, b in zip(these, others, strict=True)))


def where_rows(chosen: Tensor, these: Tensor, others: Tensor) -> Tensor:
    """The rows of one tensor (N, ...) where `chosen` (N,), those of the other elsewhere."""
    return torch.where(chosen.reshape(-1, *[1] * (these.dim() - 1)), these, others)


def yaw_rate(
    yaw: Tensor, v: Tensor, control: FlatnessControllerConfig, heading: Tensor | None
) -> Tensor:
    """The controller's yaw rate (N,) [rad/s] of level vehicles at `yaw` (N,) [rad]."""
    along, strength = heading_along_motion(v, control.yaw_speed)
    if heading is not None:
        along, strength = heading, torch.ones_like(strength)
    error = torch.remainder(along - yaw + torch.pi, 2 * torch.pi) - torch.pi
    return (control.yaw_gain * strength * error).clamp(-control.max_yaw_rate, control.max_yaw_rate)


def _up(like: Tensor, size: float) -> Tensor:
    return torch.tensor([0.0, 0.0, size], device=like.device)


def _decay_gradient(x: Tensor, factor: float) -> Tensor:
    return torch.lerp(x.detach(), x, factor)


# Vehicles as they were when the image was taken that was the last to come, in torch.
#
# The twin of `splatpilot.systems.sensing.latency.DelayedPose` and of its `FrameTimes`, whose
# samples are the steps of the policy.


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
