"""Quintics between boundary states, the acceleration that they begin with, fans of velocities, and
choosing distinct trajectories."""

import math
from collections.abc import Sequence

import numpy as np

from splatpilot.systems.vehicle.quadrotor import QuadrotorParams

STEEPEST = 0.5  # Cosine of the tilt beyond which the acceleration is taken to grow no further.


def quintic_basis(times: np.ndarray, horizon: float, derivative: int = 0) -> np.ndarray:
    """The matrix (n, 6) that evaluates quintics at `times` (n,) [s].

    Times the boundary states (p_0, v_0, a_0, p_1, v_1, a_1) it gives that `derivative` of the one
    quintic that has position p_0, velocity v_0 and acceleration a_0 at time 0 and p_1, v_1, a_1 at
    `horizon` [s].
    """

    def monomials(t: np.ndarray, order: int) -> np.ndarray:
        """The derivatives of order `order` of 1, t, ..., t^5: (n, 6)."""
        powers = np.arange(6)
        factors = np.array([math.perm(k, order) for k in range(6)])
        return factors * t[:, None] ** np.maximum(powers - order, 0)

    ends = np.array([0.0, horizon])
    conditions = np.stack([monomials(ends, order) for order in range(3)], axis=1)  # (2, 3, 6)
    return monomials(np.asarray(times, dtype=float), derivative) @ np.linalg.inv(
        conditions.reshape(6, 6)
    )


def level_acceleration(R_WB: np.ndarray, v_WB: np.ndarray, params: QuadrotorParams) -> np.ndarray:
    """The acceleration a_WB (3,) [m/s^2] of level flight at this attitude and velocity.

    The thrust that carries the weight, c = g / (z_B · e_z), accelerates along the horizontal part
    of the body z axis z_B, against the drag. A plan that starts with this acceleration goes on
    smoothly from the last.
    """
    tilt = R_WB[:2, 2] / max(R_WB[2, 2], STEEPEST)
    return np.append(params.gravity * tilt - params.drag * v_WB[:2], 0.0)


def velocity_fan(
    yaws: np.ndarray, pitches: np.ndarray, speeds: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Velocities (N, 3) of each of the speeds in each of the directions.

    Of a frame whose x axis points ahead: yaws [rad] are about z and positive to the left, pitches
    [rad] positive upwards.
    """
    yaw, pitch, speed = np.meshgrid(yaws, pitches, speeds, indexing="ij")
    forward, left, up = np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)
    return (speed * np.stack([forward, left, up])).reshape(3, -1).T


def rotation_to(direction_W: np.ndarray) -> np.ndarray:
    """The rotation R_WL (3, 3) whose x axis points along `direction_W` (3,) and whose y is level.

    A zero direction gives the world's axes, a vertical one has y along the world's y.
    """
    length = np.linalg.norm(direction_W)
    x_W = direction_W / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    level = math.hypot(x_W[0], x_W[1])
    y_W = np.array([-x_W[1], x_W[0], 0.0]) / level if level > 1e-6 else np.array([0.0, 1.0, 0.0])
    return np.column_stack([x_W, y_W, np.cross(x_W, y_W)])


def select_distinct(
    positions: np.ndarray, costs: np.ndarray, count: int, separation: float
) -> np.ndarray:
    """The indices (count,) of cheap trajectories that differ, cheapest first.

    Greedy: the cheapest, then time and again the cheapest of those whose mean distance from every
    one chosen exceeds `separation`. Once none does, the most distant of the rest.

    Args:
        positions: (N, S, 3) [m].
        costs: (N,).
        count: K <= N.
        separation: [m].
    """
    chosen = [int(np.argmin(costs))]
    apart = np.full(len(costs), np.inf)
    while len(chosen) < count:
        apart = np.minimum(apart, lengths(positions - positions[chosen[-1]]).mean(axis=1))
        apart[chosen] = -1.0  # Never twice.
        distinct = apart > separation
        if distinct.any():
            chosen.append(int(np.argmin(np.where(distinct, costs, np.inf))))
        else:
            chosen.append(int(np.argmax(apart)))
    return np.array(chosen)[np.argsort(costs[chosen], kind="stable")]


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (...,) of vectors (..., 3)."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
