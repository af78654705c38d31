"""Encodings of observations and network outputs, for numpy arrays and torch tensors.

The heading frame H has its origin in the vehicle, z up and x above the body's x axis. Leading
dimensions `...` are batches.
"""

from typing import Any

from splatpilot.systems.vehicle.state import array_namespace, clip, stack


def pool_depth(depth: Any, height: int, width: int) -> Any:
    """Returns the minimum (..., height, width) [m] of each block of planar depth (..., H, W) [m].

    Obstacles thinner than a coarse pixel stay visible.
    """
    *batch, H, W = depth.shape
    blocks = depth.reshape(*batch, height, H // height, width, W // width)
    return array_namespace(depth).amin(blocks, (-3, -1))


def inverse_depth(depth: Any, min_depth: float, max_depth: float) -> Any:
    """Encodes planar depth (...,) [m] as 3 / z - 0.6, z clipped to [min_depth, max_depth]."""
    return 3.0 / depth.clip(min_depth, max_depth) - 0.6


def heading_frame(yaw: Any) -> Any:
    """Returns R_WH (..., 3, 3), the rotation about z by `yaw` (...,) [rad]."""
    xp = array_namespace(yaw)
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    zero, one = xp.zeros_like(yaw), xp.ones_like(yaw)
    entries = xp.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1)
    return entries.reshape(*entries.shape[:-1], 3, 3)


def target_velocity(p_WB: Any, p_WG: Any, speed: Any, slowing_time: float = 1.0) -> Any:
    """Returns the velocity (..., 3) [m/s] straight to the goal: (p_WG - p_WB) / max(distance /
    speed, slowing_time), at `speed` (...,) [m/s] until `slowing_time` [s] before it."""
    to_goal = p_WG - p_WB
    distance = array_namespace(to_goal).sqrt(clip((to_goal * to_goal).sum(-1), low=1e-6))
    return to_goal / stack([clip(distance / speed, low=slowing_time)])


def heading_observation(p_WB: Any, v_WB: Any, z_WB: Any, p_WG: Any, speed: Any, R_WH: Any) -> Any:
    """Returns (..., 9): target velocity, velocity [m/s] and the body's z axis z_WB, all (..., 3),
    in the heading frame."""
    rows = [target_velocity(p_WB, p_WG, speed), v_WB, z_WB]
    rows = array_namespace(v_WB).stack(rows, -2) @ R_WH
    return rows.reshape(*rows.shape[:-2], 9)


def limit_smoothly(output: Any, limits: Any) -> Any:
    """Limits a network's output (..., N) smoothly to +-limits (N,)."""
    return limits * array_namespace(output).tanh(output / limits)
