"""Many vehicles in flight at once, differentiable, in torch.

`PointMass` follows accelerations with a lag and turns its nose along its motion, which is what
`FlatnessController` makes of the body-rate quadrotor: cheap enough to learn through. `BodyRate` is
that quadrotor, with the very equations of the simulated plant
(`systems.vehicle.quadrotor_dynamics`), under the controller's own law: what it does beyond the
point mass tells what the latter leaves out.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams, rk4_step
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

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
        return torch.nn.functional.normalize(self._thrust(), dim=1)

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
        return rotation_matrix(QuadrotorState.of(self.state).q_WB)

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
            command = flatness_command(state, a_cmd, control, params, heading)
            state = rk4_step(state, command, params, dt / count)
        change = QuadrotorState.of(state).v_WB - QuadrotorState.of(before).v_WB
        return BodyRate(state, change * (count / dt))


Vehicle = PointMass | BodyRate


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


def flatness_command(
    state: Tensor,
    a_WB: Tensor,
    control: FlatnessControllerConfig,
    params: QuadrotorParams,
    heading: Tensor | None = None,
) -> Tensor:
    """Thrust and body rates (N, 4), the law of `FlatnessController` for accelerations (N, 3)."""
    _, v, q_WB, _ = QuadrotorState.of(state)
    f = a_WB + params.drag * v
    f = f + _up(f, params.gravity)
    lift = f[:, 2:].clamp(min=control.min_thrust)
    level = f[:, :2]
    widest = lift * torch.tan(torch.tensor(control.max_tilt))
    level = level * (widest / level.norm(dim=1, keepdim=True).clamp(min=1e-6)).clamp(max=1.0)
    f = torch.cat([level, lift], 1)
    f = f * (control.max_thrust / f.norm(dim=1, keepdim=True)).clamp(max=1.0)

    R_WB = rotation_matrix(q_WB)
    heading, pull = heading_and_pull(v, control, heading)
    R_BD = R_WB.mT @ attitude_from_thrust(f, heading)
    # First the shortest turn of the body's z axis, about n in its x-y plane, then yaw.
    z1, z2, z3 = R_BD[:, :, 2].unbind(1)
    sine = torch.sqrt(z1 * z1 + z2 * z2 + 1e-12)
    angle = torch.atan2(sine, z3)
    n1, n2 = -z2 / sine, z1 / sine
    rates = control.tilt_gain * torch.stack([angle * n1, angle * n2], 1)
    rates = rates * (control.max_tilt_rate / rates.norm(dim=1, keepdim=True).clamp(min=1e-6)).clamp(
        max=1.0
    )
    x1, x2, x3 = R_BD[:, :, 0].unbind(1)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    along = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + along * n1
    left = cosine * x2 + sine * n1 * x3 + along * n2
    yaw = control.yaw_gain * pull * torch.atan2(left, ahead)
    yaw = yaw.clamp(-control.max_yaw_rate, control.max_yaw_rate)
    thrust = (f * R_WB[:, :, 2]).sum(1).clamp(control.min_thrust, control.max_thrust)
    return torch.cat([thrust[:, None], rates, yaw[:, None]], 1)


def heading_and_pull(
    v: Tensor, control: FlatnessControllerConfig, heading: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Where to look (N,) [rad], `heading` or along the velocity, and how strongly (N,), 0 to 1."""
    if heading is not None:
        return heading, torch.ones_like(heading)
    pull = (v[:, :2].norm(dim=1) / control.yaw_speed).clamp(max=1.0).square()
    return torch.atan2(v[:, 1], v[:, 0]), pull


def yaw_rate(
    yaw: Tensor, v: Tensor, control: FlatnessControllerConfig, heading: Tensor | None
) -> Tensor:
    """The controller's yaw rate (N,) [rad/s] of level vehicles at `yaw` (N,) [rad]."""
    heading, pull = heading_and_pull(v, control, heading)
    error = torch.remainder(heading - yaw + torch.pi, 2 * torch.pi) - torch.pi
    return (control.yaw_gain * pull * error).clamp(-control.max_yaw_rate, control.max_yaw_rate)


def attitude_from_thrust(f: Tensor, yaw: Tensor) -> Tensor:
    """R_WB (N, 3, 3) with z along f (N, 3), upwards, and x above the direction of yaw (N,)."""
    z = torch.nn.functional.normalize(f, dim=1)
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    x = torch.stack([cos * z[:, 2], sin * z[:, 2], -sin * z[:, 1] - cos * z[:, 0]], 1)
    x = torch.nn.functional.normalize(x, dim=1)
    return torch.stack([x, torch.linalg.cross(z, x), z], 2)


def rotation_matrix(q: Tensor) -> Tensor:
    """The rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(q, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def _up(like: Tensor, size: float) -> Tensor:
    return torch.tensor([0.0, 0.0, size], device=like.device)


def _decay_gradient(x: Tensor, factor: float) -> Tensor:
    return torch.lerp(x.detach(), x, factor)
