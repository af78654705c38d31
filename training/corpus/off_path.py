"""States that no good flight comes to: anywhere in free space, half of them before a surface.

An expert keeps clear of everything, so what it sees is never near and straight ahead; whoever
learns to judge distances from its flights alone does not know what is. Nor does it ever stand a few
metres from its goal; whoever learns from its flights alone stops there, and stays.
"""

import numpy as np
from pydrake.math import RollPitchYaw

from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.training.policies.expert import Labeller

STATES_A_LOOK = 60
"""Whoever changes the look of the world does so after so many."""

_ROOM = 0.05  # [m], least clearance
_BEFORE = 1.0  # [m], greatest clearance before a surface
_UPRIGHT = 0.5  # [-], least horizontal part of its normal
_ARRIVING = 4.0  # [m], greatest distance from the goal of those that are near it
_CANDIDATES = 8  # for each state
_TURN = 0.6  # [rad], standard deviation of the yaw about the way, or about the nearest surface
_LEAN = 0.12  # [rad], standard deviation of roll and pitch
_BRAKING = 3.0  # [m/s^2], with which none is too fast to stop before the nearest surface
_SIDEWAYS = 0.3  # [m/s], standard deviation


def draw_off_path(
    labeller: Labeller, count: int, speed: float, rng: np.random.Generator
) -> np.ndarray:
    """
    States (count, 13) from which a way leads to the goal.

    Half are within a metre of a surface that is not the ground's and look at it, if there are so
    many among candidates. Of the others half are within 4 m of the goal, as many at any distance,
    and look anywhere; half are uniform in space and look along the way. All deviate from that, and
    fly where they look, at up to `speed` [m/s] and no faster than they can stop.

    Raises:
        InfeasibleFlightError: if no place has room.
    """
    field, toa = labeller.field, labeller.toa
    cells = np.argwhere(toa.reachable & (field.distances > VEHICLE_RADIUS + _ROOM))
    if len(cells) == 0:
        raise InfeasibleFlightError("no place from which a way leads to the goal has room")
    centers = field.lower_W + field.voxel_size * (cells + 0.5)
    candidates = centers[rng.integers(len(centers), size=_CANDIDATES * count)]
    to_goal = np.linalg.norm(centers - toa.p_WG, axis=1)
    share = np.where(to_goal < _ARRIVING, 1.0 / np.maximum(to_goal, field.voxel_size) ** 2, 0.0)
    near = count // 4 if share.any() else 0
    arriving = centers[rng.choice(len(centers), near, p=share / share.sum())] if near else []
    candidates = np.concatenate([np.reshape(arriving, (-1, 3)), candidates])
    seen = field.query(candidates)
    before = np.linalg.norm(seen.gradient[:, :2], axis=1) > _UPRIGHT
    before &= seen.distance < VEHICLE_RADIUS + _BEFORE
    before[:near] = False
    before = np.flatnonzero(before)[: count // 2]
    chosen = np.concatenate([before, np.arange(count - len(before))])
    p_WB, distance = candidates[chosen], seen.distance[chosen]
    towards = toa.gradient(p_WB)
    towards[: len(before)] = seen.gradient[before]
    yaw = np.arctan2(-towards[:, 1], -towards[:, 0]) + _TURN * rng.normal(size=count)
    yaw[len(before) : len(before) + near] = rng.uniform(-np.pi, np.pi, near)
    roll, pitch = _LEAN * rng.normal(size=(2, count))
    fastest = np.sqrt(2.0 * _BRAKING * np.maximum(distance - VEHICLE_RADIUS, 0.0))
    ahead = np.minimum(speed, fastest) * rng.random(count)
    aside, up = _SIDEWAYS * rng.normal(size=(2, count))
    cos, sin = np.cos(yaw), np.sin(yaw)
    v_WB = np.stack([cos * ahead - sin * aside, sin * ahead + cos * aside, up], axis=1)
    return np.stack(
        [
            QuadrotorState(
                p_WB[n],
                v_WB[n],
                RollPitchYaw(roll[n], pitch[n], yaw[n]).ToQuaternion().wxyz(),
                np.zeros(3),
            ).to_vector()
            for n in range(count)
        ]
    )
