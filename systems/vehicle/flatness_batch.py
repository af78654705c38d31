"""The law of `FlatnessController` for many vehicles at once.

The same formulas serve numpy arrays and torch tensors, differentiable as these are, so that flights
that only gather data need no torch and fly as those that are trained through. Single vehicles have
the law in `flatness`, on floats.
"""

import math
import sys
from types import ModuleType
from typing import Any

import numpy as np

from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


def flatness_commands(
    state: Any,
    a_WB: Any,
    control: FlatnessControllerConfig,
    params: QuadrotorParams,
    heading: Any = None,
) -> Any:
    """Thrust over mass and body rates (N, 4) that fly accelerations, see `FlatnessController`.

    Args:
        state: (N, 13).
        a_WB: (N, 3) [m/s^2], gravity excluded.
        control: the controller's constants.
        params: of the vehicles.
        heading: (N,) [rad], where they look; None: along their velocity.
    """
    xp = _namespace(state)
    _, v, q_WB, _ = QuadrotorState.of(state)
    f = a_WB + params.drag * v
    level, lift = f[:, :2], (f[:, 2:] + params.gravity).clip(min=control.min_thrust)
    widest = lift * math.tan(control.max_tilt)
    level = level * (widest / lengths(level).clip(min=1e-6)).clip(max=1.0)
    f = xp.concatenate([level, lift], 1)
    f = f * (control.max_thrust / lengths(f)).clip(max=1.0)

    R_WB = rotation_matrices(q_WB)
    heading, pull = headings_and_pulls(v, control, heading)
    R_BD = R_WB.mT @ attitudes_from_thrust(f, heading)
    # First the shortest turn of the body's z axis, about n in its x-y plane, then yaw.
    z1, z2, z3 = (R_BD[:, i, 2] for i in range(3))
    sine = xp.sqrt(z1 * z1 + z2 * z2 + 1e-12)
    angle = xp.arctan2(sine, z3)
    n1, n2 = -z2 / sine, z1 / sine
    rates = control.tilt_gain * xp.stack([angle * n1, angle * n2], 1)
    rates = rates * (control.max_tilt_rate / lengths(rates).clip(min=1e-6)).clip(max=1.0)
    x1, x2, x3 = (R_BD[:, i, 0] for i in range(3))
    cosine, sine = xp.cos(angle), xp.sin(angle)
    along = (n1 * x1 + n2 * x2) * (1.0 - cosine)
    ahead = cosine * x1 - sine * n2 * x3 + along * n1
    left = cosine * x2 + sine * n1 * x3 + along * n2
    yaw = control.yaw_gain * pull * xp.arctan2(left, ahead)
    yaw = yaw.clip(min=-control.max_yaw_rate, max=control.max_yaw_rate)
    thrust = (f * R_WB[:, :, 2]).sum(1).clip(min=control.min_thrust, max=control.max_thrust)
    return xp.concatenate([thrust[:, None], rates, yaw[:, None]], 1)


def headings_and_pulls(v: Any, control: FlatnessControllerConfig, heading: Any) -> tuple[Any, Any]:
    """Where to look (N,) [rad], `heading` or along the velocity v (N, 3), and how strongly (N,),
    0 to 1."""
    xp = _namespace(v)
    if heading is not None:
        return heading, xp.ones_like(heading)
    pull = (lengths(v[:, :2])[:, 0] / control.yaw_speed).clip(max=1.0)
    return xp.arctan2(v[:, 1], v[:, 0]), pull * pull


def attitudes_from_thrust(f: Any, yaw: Any) -> Any:
    """R_WB (N, 3, 3) with z along f (N, 3), upwards, and x above the direction of yaw (N,)."""
    xp = _namespace(f)
    z = unit_vectors(f)
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x = xp.stack([cos * z[:, 2], sin * z[:, 2], -sin * z[:, 1] - cos * z[:, 0]], 1)
    x = unit_vectors(x)
    return xp.stack([x, _cross(z, x), z], 2)


def rotation_matrices(q: Any) -> Any:
    """The rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any length."""
    xp = _namespace(q)
    w, x, y, z = unit_vectors(q).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return xp.stack(rows, 1).reshape(-1, 3, 3)


def lengths(vectors: Any) -> Any:
    """Lengths (N, 1) of vectors (N, n); of tensors with gradient zero where they are zero."""
    xp = _namespace(vectors)
    if xp is np:
        return np.sqrt((vectors * vectors).sum(1, keepdims=True))
    return xp.linalg.vector_norm(vectors, dim=1, keepdim=True)


def unit_vectors(vectors: Any) -> Any:
    """Vectors (N, n) at unit length; zero stays zero."""
    return vectors / lengths(vectors).clip(min=1e-12)


def _cross(a: Any, b: Any) -> Any:
    """a x b, (N, 3) each; numpy's own costs ten times as much on few."""
    xp = _namespace(a)
    if xp is not np:
        return xp.linalg.cross(a, b)
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return np.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], 1)


def _namespace(array: Any) -> ModuleType:
    """The module whose functions an array takes: numpy or torch."""
    torch = sys.modules.get("torch")  # A tensor can only come from a torch already imported.
    return torch if torch is not None and isinstance(array, torch.Tensor) else np
