"""Rewards of the environments, for batches of N vehicles."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.validation import Config, bounded
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


class Transition(NamedTuple):
    """One step of N vehicles."""

    states: NDArray[np.float64]  # (N, 13) at its beginning, see `QuadrotorState`
    next_states: NDArray[np.float64]  # (N, 13) at its end
    p_WG: NDArray[np.float64]  # (N, 3) [m], goals
    distances: NDArray[np.float64]  # (N,) [m] from p_WB at its end to the nearest surface, or NaN
    actions: NDArray[np.float64]  # (N, n) in [-1, 1]
    previous_actions: NDArray[np.float64]  # (N, n); zeros in the first step of a flight
    reached: NDArray[np.bool_]  # (N,), the flight ended at the goal
    failed: NDArray[np.bool_]  # (N,), the flight ended by a collision or outside of the world
    duration: float  # [s]
    radius: float = VEHICLE_RADIUS  # [m] of the vehicle


@dataclass
class Reward(Config):
    """Default reward: the sum of the terms, each times its weight.

    Replace it by any function of a `Transition` that returns (N,).
    """

    # [1/m] Of progress: how much nearer the goal is than before.
    progress: float = bounded(1.0, "(-inf, inf) 1/m")
    # [1/(m s)] Of the barrier, the collision penalty of `soft_barrier`, over time.
    barrier: float = bounded(-0.5, "(-inf, inf) 1/(m s)")
    # [1/m] Sharpness of the barrier.
    beta: float = bounded(8.0, "(0, inf) 1/m")
    # [m] Clearance at which the barrier rises.
    margin: float = bounded(0.3, "(-inf, inf) m")
    # [-] Of smoothness: the mean square of the change of the action.
    smoothness: float = bounded(-0.02, "(-inf, inf)")
    # [1/s] Of time in flight.
    time: float = bounded(-0.2, "(-inf, inf) 1/s")
    # [-] Of the arrival at the goal.
    success: float = bounded(10.0, "(-inf, inf)")
    # [-] Of a collision, and of leaving the world.
    failure: float = bounded(-10.0, "(-inf, inf)")

    def terms(self, transition: Transition) -> dict[str, Any]:
        """Returns the terms (N,) by their names, times their weights."""
        t = transition
        before, after = (
            np.sqrt(((t.p_WG - states[..., :3]) ** 2).sum(-1))
            for states in (t.states, t.next_states)
        )
        barrier = soft_barrier(t.distances, t.radius, self.beta, self.margin)
        change = ((t.actions - t.previous_actions) ** 2).mean(-1)
        return {
            "progress": self.progress * (before - after),
            "barrier": self.barrier * t.duration * np.nan_to_num(barrier, nan=0.0),
            "smoothness": self.smoothness * change,
            "time": np.full(len(change), self.time * t.duration),
            "success": self.success * t.reached,
            "failure": self.failure * t.failed,
        }

    def __call__(self, transition: Transition) -> NDArray[np.float64]:
        """Returns the rewards (N,)."""
        return np.sum(list(self.terms(transition).values()), axis=0)
