"""Motion primitives: quintics, fans of velocities, selection of distinct trajectories."""

import math
from collections.abc import Sequence

import numpy as np

from splatpilot.systems.vehicle.quadrotor import QuadrotorParams

MIN_UPRIGHT = 0.5  # Cosine of the tilt above which `level_acceleration` stays constant.


def quintic_basis(times: np.ndarray, horizon: float, derivative: int = 0) -> np.ndarray:
    """Computes the matrix (n, 6) that evaluates quintics at `times` (n,) [s].

    Its product with the boundary states (p_0, v_0, a_0, p_1, v_1, a_1) at times 0 and `horizon` [s]
    is that `derivative` of the quintic between them.
    """

    def monomials(t: np.ndarray, order: int) -> np.ndarray:  # (n, 6), of 1, t, ..., t^5
        powers = np.arange(6)
        factors = np.array([math.perm(k, order) for k in range(6)])
        return factors * t[:, None] ** np.maximum(powers - order, 0)

    ends = np.array([0.0, horizon])
    conditions = np.stack([monomials(ends, order) for order in range(3)], axis=1)  # (2, 3, 6)
    return monomials(np.asarray(times, dtype=float), derivative) @ np.linalg.inv(
        conditions.reshape(6, 6)
    )


def level_acceleration(R_WB: np.ndarray, v_WB: np.ndarray, params: QuadrotorParams) -> np.ndarray:
    """Computes a_WB (3,) [m/s^2] of level flight at this attitude and velocity.

    The thrust that carries the weight, c = g / (z_B · e_z), accelerates along the horizontal part
    of z_B, against the drag. Plans that start with this acceleration continue the last smoothly.
    """
    tilt = R_WB[:2, 2] / max(R_WB[2, 2], MIN_UPRIGHT)
    return np.append(params.gravity * tilt - params.drag * v_WB[:2], 0.0)


def velocity_fan(
    yaws: np.ndarray, pitches: np.ndarray, speeds: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Returns velocities (N, 3) of all speeds in all directions, in a frame with x ahead.

    Yaws [rad] are positive to the left, pitches [rad] positive upwards.
    """
    yaw, pitch, speed = np.meshgrid(yaws, pitches, speeds, indexing="ij")
    forward, left, up = np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)
    return (speed * np.stack([forward, left, up])).reshape(3, -1).T


def rotation_to(direction_W: np.ndarray) -> np.ndarray:
    """Returns R_WL (3, 3) with its x axis along `direction_W` (3,) and its y axis level.

    A zero direction gives the world's axes; a vertical one has y along the world's y.
    """
    length = np.linalg.norm(direction_W)
    x_W = direction_W / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    level = math.hypot(x_W[0], x_W[1])
    y_W = np.array([-x_W[1], x_W[0], 0.0]) / level if level > 1e-6 else np.array([0.0, 1.0, 0.0])
    return np.column_stack([x_W, y_W, np.cross(x_W, y_W)])


def select_distinct(
    positions: np.ndarray, costs: np.ndarray, count: int, separation: float
) -> np.ndarray:
    """Returns the indices (count,) of cheap distinct trajectories, cheapest first.

    Greedy: repeatedly the cheapest of positions (N, S, 3) [m] whose mean distance from all chosen
    ones exceeds `separation` [m]; without one, the most distant.
    """
    chosen = [int(np.argmin(costs))]
    apart = np.full(len(costs), np.inf)
    while len(chosen) < count:
        apart = np.minimum(apart, norms(positions - positions[chosen[-1]]).mean(axis=1))
        apart[chosen] = -1.0  # not again
        distinct = apart > separation
        if distinct.any():
            chosen.append(int(np.argmin(np.where(distinct, costs, np.inf))))
        else:
            chosen.append(int(np.argmax(apart)))
    return np.array(chosen)[np.argsort(costs[chosen], kind="stable")]


def norms(vectors: np.ndarray) -> np.ndarray:
    """Returns the lengths (...,) of vectors (..., 3)."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
