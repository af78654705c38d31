"""Trains DepthNav: through the dynamics, down the time of arrival, heading along the path.

After "Quadrotor Navigation using Reinforcement Learning with Privileged Information" (2025,
arXiv:2509.08177), with its weights of the loss. Different here: 25 Hz, 32 vehicles and 40 steps per
update for a CPU; the mean velocity of 0.5 s and a gradient decay, without which vehicles learn to
hover; velocity and attitude quaternion as the state; target velocity and speed; yaw from the
direction of the goal, with the loss 1 - cos of its angle to the path; rates from jerk over gravity.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from splatpilot.systems.policies import depthnav
from splatpilot.systems.policies.base import heading_frame, limit_smoothly, target_velocity
from splatpilot.systems.vehicle.quadrotor import GRAVITY
from splatpilot.training.policies.networks import TrainableNetwork
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.rollouts import RolloutConfig, RolloutTraining, Transitions
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.vehicles import Observation


@dataclass
class DepthNavLoss:
    """Weights of the terms of the loss."""

    # [s/m] Smooth L1 of the mean velocity's error.
    velocity: float = 4.0
    # [-] Velocity toward the nearest obstacle times max(0, 1 - d)², d [m], and its proximity.
    collision: float = 6.0
    # [m/s] Weight of ln(1 + exp(-6 d)) in that, at any velocity; 2.5 as published.
    nearness: float = 0.5
    # [s^4/m^2] Square of the acceleration.
    acceleration: float = 0.01
    # [s^6/m^2] Square of the jerk.
    jerk: float = 0.001
    # [s^2] Square of the rates of tilt.
    rate: float = 0.3
    # [-] 1 - cos of the angle between the commanded heading and the path.
    yaw: float = 4.0


@dataclass
class DepthNavTraining(RolloutTraining):
    """A training run of DepthNav."""

    schedule: Schedule = field(default_factory=lambda: Schedule(updates=12000, validate_every=500))
    rollout: RolloutConfig = field(
        default_factory=lambda: RolloutConfig(environments=32, steps=40, averaging=0.5)
    )
    empty: float = 0.05
    loss: DepthNavLoss = field(default_factory=DepthNavLoss)


class DepthNavLearner:
    """Flies by DepthNav's network, see `splatpilot.training.policies.rollouts.Learner`."""

    rate = depthnav.RATE

    def __init__(self, loss: DepthNavLoss, device: torch.device | str = "cpu") -> None:
        spec = depthnav.DEPTHNAV_NETWORK
        width, height = depthnav.CAMERA_SIZE
        aspect = (height / spec.image_height) / (width / spec.image_width)
        self.rays = PixelRays.of(spec.image_width, spec.image_height, depthnav.FOV_X, aspect)
        self.network = TrainableNetwork(spec, head_scale=1.0).to(device)
        self._loss = loss
        limits = depthnav.ACCELERATION_LIMITS
        self._limits = torch.tensor(limits, dtype=torch.float32, device=device)

    def initial_memory(self, count: int) -> Tensor:
        """Returns the network's hidden states and the yaw of the start frame, NaN at first."""
        memory = torch.zeros(count, self.network.spec.hidden_size + 1, device=self._limits.device)
        memory[:, -1] = torch.nan
        return memory

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        spec, vehicle, speed = self.network.spec, seen.vehicle, seen.speed
        start_yaw = torch.where(memory[:, -1].isnan(), vehicle.yaw, memory[:, -1]).detach()
        R_WS = heading_frame(start_yaw)
        image = 1.0 / seen.depth.clamp(depthnav.MIN_DEPTH, depthnav.MAX_DEPTH)
        v_target = target_velocity(vehicle.p, seen.p_WG, speed)
        q_SB = quaternion_from_rotation(R_WS.mT @ vehicle.attitude())
        state = torch.cat([_rows(vehicle.v, R_WS), q_SB, _rows(v_target, R_WS), speed[:, None]], 1)
        image = image.reshape(-1, *spec.image_size()[1:])
        output, hidden = self.network(image, state, memory[:, :-1])
        a_S = limit_smoothly(output[:, :3], self._limits)
        to_goal = torch.atan2(v_target[:, 1], v_target[:, 0]).detach()
        heading = to_goal + torch.pi * torch.tanh(output[:, 3] / torch.pi)
        a_WB = (R_WS @ a_S[:, :, None])[:, :, 0]
        return a_WB, heading, torch.cat([hidden, start_yaw[:, None]], 1)

    def losses(self, transitions: Transitions) -> dict[str, Tensor]:
        d, approach = transitions.clearance[:, 0], transitions.approach[:, 0].clamp(min=0.0)
        collision = approach * (1.0 - d).clamp(min=0.0).square()
        collision = collision + self._loss.nearness * torch.nn.functional.softplus(-6.0 * d)
        assert transitions.heading is not None
        path = torch.atan2(transitions.v_target[:, 1], transitions.v_target[:, 0])
        rate = transitions.jerk[:, :2].square().sum(1) / GRAVITY**2
        yaw = 1.0 - torch.cos(transitions.heading - path)
        return transitions.losses(self._loss, collision=collision, rate=rate, yaw=yaw)


def quaternion_from_rotation(R: Tensor) -> Tensor:
    """Computes quaternions (N, 4) wxyz, w >= 0, of rotations (N, 3, 3), differentiable."""
    m00, m11, m22 = R.diagonal(dim1=1, dim2=2).unbind(1)
    yz, zx, xy = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    sxy, szx, syz = R[:, 1, 0] + R[:, 0, 1], R[:, 0, 2] + R[:, 2, 0], R[:, 2, 1] + R[:, 1, 2]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, yz, zx, xy], 1),
            torch.stack([yz, 1 + m00 - m11 - m22, sxy, szx], 1),
            torch.stack([zx, sxy, 1 - m00 + m11 - m22, syz], 1),
            torch.stack([xy, szx, syz, 1 - m00 - m11 + m22], 1),
        ],
        1,
    )  # (N, 4, 4), each row the quaternion times four times one of its components
    largest = candidates.diagonal(dim1=1, dim2=2).argmax(1)
    q = candidates[torch.arange(len(R), device=R.device), largest]
    q = torch.nn.functional.normalize(q, dim=1)
    return torch.where(q[:, :1] < 0.0, -q, q)


def _rows(vectors: Tensor, R: Tensor) -> Tensor:
    """Computes R^T v (N, 3) of vectors (N, 3)."""
    return (vectors[:, None, :] @ R)[:, 0]
