"""A lattice of quintic point-mass trajectories, their costs and the K best distinct ones.

Quintics, minimum-jerk curves, lead from the present state to a fan of final velocities and to
points of the path to the goal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, slowness
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams

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
) -> tuple[np.ndarray, bool]:
    """Returns the indices (count,) of cheap trajectories, cheapest first, and if all are distinct.

    Greedy: repeatedly the cheapest of positions (N, S, 3) [m] whose mean distance from all chosen
    ones exceeds `separation` [m]; without one, the most distant.
    """
    chosen, all_distinct = [int(np.argmin(costs))], len(costs) >= count
    apart = np.full(len(costs), np.inf)
    while len(chosen) < min(count, len(costs)):
        apart = np.minimum(apart, norms(positions - positions[chosen[-1]]).mean(axis=1))
        apart[chosen] = -1.0  # not again
        distinct = apart > separation
        if distinct.any():
            chosen.append(int(np.argmin(np.where(distinct, costs, np.inf))))
        else:
            chosen.append(int(np.argmax(apart)))
            all_distinct = False
    return np.array(chosen)[np.argsort(costs[chosen], kind="stable")], all_distinct


def norms(vectors: np.ndarray) -> np.ndarray:
    """Returns the lengths (...,) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors * vectors, -1, 0)  # faster than sums over three numbers each
    return np.sqrt(x + y + z)


MIN_SPEED_FRACTION = 0.25  # of the nominal speed, near the goal

_PACES = 1.0, 0.5, 0.25
"""Fractions of the nominal speed, tried in turn until a trajectory beats waiting; only the quintics
of slow lattices follow narrow bends."""

_FIRST_COUNT = 64  # Trajectories; the best are often among those that arrive first.
_ROUNDING = 1e-6  # [s] bound on that of a cost


@dataclass
class LatticeConfig(Config):
    """The lattice, the weights of its cost and the number of trajectories to keep.

    The cost of a trajectory with samples p_i, in seconds at 1 m/s, is::

        T(p_N) + sum (S(d_i) - 1) |p_i - p_(i-1)|           time of arrival and proximity
        + penetration_weight sum max(0, r + margin - d_i)   contact
        + speed_weight mean max(0, |v_i| - speed)² + jerk_weight mean |j_i|²

    with the time of arrival T, the slowness S, the distances d_i and the radius r. T and S must
    match, so that a trajectory along the path to the goal always costs less than waiting.
    """

    # [m/s] Nominal speed.
    speed: float = bounded(2.0, "(0, 20] m/s")
    # [s] Duration of the trajectories, a multiple of 0.1 s, the time between samples.
    horizon: float = bounded(2.0, "(0, 30] s")
    # [-] Number of directions to the sides.
    num_yaws: int = bounded(25, "[1, inf)")
    # [rad] Maximum angle to the sides.
    max_yaw: float = bounded(1.745, "[0, 3.1416] rad")
    # [-] Number of directions up and down.
    num_pitches: int = bounded(7, "[1, inf)")
    # [rad] Maximum angle up and down.
    max_pitch: float = bounded(0.5, "[0, 1.5707] rad")
    # [-] Final speeds as fractions of the nominal speed.
    speed_fractions: list[float] = bounded(lambda: [0.33, 0.67, 1.0], "(0, 1]")
    # [-] Number of trajectories to keep.
    num_hypotheses: int = bounded(3, "[1, inf)")
    # [m] Mean distance between distinct trajectories.
    separation: float = bounded(0.35, "[0, 1e6] m")
    # [m] Clearance for errors of tracking and of the field's grid.
    margin: float = bounded(0.05, "[0, 1e6] m")
    # [s/m] Weight of penetrating radius and margin.
    penetration_weight: float = bounded(200.0, "[0, 1e6]")
    # [s^3/m^2] Weight of exceeding the nominal speed.
    speed_weight: float = bounded(10.0, "[0, 1e6]")
    # [s^7/m^2] Weight of the jerk.
    jerk_weight: float = bounded(0.003, "[0, 1e6]")

    def check(self) -> None:
        samples = self.horizon / WAYPOINT_PERIOD
        whole = samples > NUM_WAYPOINTS - 0.5 and abs(samples - round(samples)) < 1e-6
        require_field(self, "horizon", whole, "a multiple of 0.1 s and at least 1.0 s")
        require_field(self, "speed_fractions", self.speed_fractions, "one or more values in (0, 1]")
        count = self.num_yaws * self.num_pitches * len(self.speed_fractions)
        require_field(self, "num_yaws", count <= 10**5, "at most 1e5 trajectories in all")
        condition = f"at most {count}, the size of the lattice"
        require_field(self, "num_hypotheses", self.num_hypotheses <= count, condition)


class Trajectories(NamedTuple):
    """Samples of trajectories in the world, every 0.1 s from 0.1 s to the horizon."""

    positions: np.ndarray  # (N, S, 3) [m]
    jerks: np.ndarray  # (N, S, 3) [m/s^3]


class TrajectoryLattice:
    """Quintics from a state to a fan of final velocities, their costs, and the best of them."""

    def __init__(self, config: LatticeConfig | None = None) -> None:
        self.config = config = config or LatticeConfig()
        config.validate()
        samples = np.arange(1, round(config.horizon / WAYPOINT_PERIOD) + 1)
        self.sample_times = WAYPOINT_PERIOD * samples  # (S,) [s]
        self._basis = np.concatenate(
            [quintic_basis(self.sample_times, config.horizon, order) for order in (0, 3)]
        )  # (2 S, 6)
        self._final_velocities_L = final_velocities(config)
        self._stopping_distance = 0.5 * config.horizon * config.speed  # [m]

    def trajectories(
        self,
        p_WB: np.ndarray,
        v_WB: np.ndarray,
        a_WB: np.ndarray,
        toa: TimeOfArrival,
        pace: float = 1.0,
    ) -> Trajectories:
        """Computes N trajectories from a position, velocity and acceleration, (3,) each.

        They end without acceleration at the horizon H: those of the lattice, along the negative
        gradient of T, at p_WB + H v_1 with velocity v_1; one more per speed on the path to the
        goal, or at rest in it. Speeds are multiplied by `pace`, and fall within H / 2 of the goal.
        """
        config = self.config
        slowing = float(toa.value(p_WB)) / self._stopping_distance
        speed = pace * config.speed * min(max(slowing, MIN_SPEED_FRACTION), 1.0)
        v_L = speed * self._final_velocities_L @ rotation_to(-toa.gradient(p_WB)).T
        speeds = speed * np.array(config.speed_fractions)
        p_path, directions = toa.path(p_WB, config.horizon * speeds)
        count = len(v_L) + len(speeds)
        boundary = np.zeros((6, count, 3))
        boundary[0], boundary[1], boundary[2] = p_WB, v_WB, a_WB
        boundary[3] = np.concatenate([p_WB + config.horizon * v_L, p_path])
        boundary[4] = np.concatenate([v_L, speeds[:, None] * directions])
        samples = self._basis @ boundary.reshape(6, -1)  # (2 S, 3 N)
        samples = samples.reshape(2, -1, count, 3).swapaxes(1, 2)
        return Trajectories(positions=samples[0], jerks=samples[1])

    def costs(
        self, trajectories: Trajectories, p_WB: np.ndarray, field: Distances, toa: TimeOfArrival
    ) -> np.ndarray:
        """Computes the costs (N,) of trajectories from p_WB (3,) [m], see `LatticeConfig`; `field`
        must be known everywhere, as `Esdf.conservative()` is."""
        config = self.config
        positions, jerks = trajectories
        distances = field.distance(positions)  # (N, S)
        starts = np.broadcast_to(p_WB, (len(positions), 1, 3))
        steps = norms(np.diff(positions, axis=1, prepend=starts))  # (N, S) [m]
        proximity = ((slowness(distances) - 1.0) * steps).sum(axis=1)
        too_close = np.maximum(VEHICLE_RADIUS + config.margin - distances, 0.0)
        too_fast = np.maximum(steps / WAYPOINT_PERIOD - config.speed, 0.0)
        return (
            toa.value(positions[:, -1])
            + proximity
            + config.penetration_weight * too_close.sum(axis=1)
            + config.speed_weight * np.square(too_fast).mean(axis=1)
            + config.jerk_weight * np.einsum("nsi,nsi->n", jerks, jerks) / jerks.shape[1]
        )

    def best(
        self,
        p_WB: np.ndarray,
        v_WB: np.ndarray,
        a_WB: np.ndarray,
        field: Distances,
        toa: TimeOfArrival,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions (K, S, 3) [m] and costs (K,) of the K best distinct trajectories.

        While the cheapest leads no nearer to a goal out of reach, slower ones are tried, and taken
        if cheaper.
        """
        arrival = float(toa.value(p_WB))
        positions, costs = np.empty(0), np.array([np.inf])
        for pace in _PACES:
            trajectories = self.trajectories(p_WB, v_WB, a_WB, toa, pace)
            found = self._select(trajectories, p_WB, field, toa)
            if found[1][0] < costs[0]:
                positions, costs = found
            nearer = toa.value(positions[0, -1]) < arrival
            if nearer or arrival < self._stopping_distance:
                break
        return positions, costs

    def _select(
        self, trajectories: Trajectories, p_WB: np.ndarray, field: Distances, toa: TimeOfArrival
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions (K, S, 3) [m] and costs (K,) of the K best distinct of trajectories."""
        config = self.config
        # No cost is below the time of arrival: in its order, most trajectories need no distances.
        arrivals = toa.value(trajectories.positions[:, -1])
        order = np.argsort(arrivals)
        count = _FIRST_COUNT
        while True:
            some = np.sort(order[:count])
            positions = trajectories.positions[some]
            costs = self.costs(Trajectories(positions, trajectories.jerks[some]), p_WB, field, toa)
            chosen, distinct = select_distinct(
                positions, costs, config.num_hypotheses, config.separation
            )
            if len(some) == len(order) or (
                distinct and costs[chosen[-1]] < arrivals[order[count]] - _ROUNDING
            ):
                return positions[chosen], costs[chosen]
            count *= 4


def final_velocities(config: LatticeConfig) -> np.ndarray:
    """Returns the final velocities (N, 3) over the speed, in the lattice frame L; the last is 0."""
    fan = velocity_fan(
        np.linspace(-config.max_yaw, config.max_yaw, config.num_yaws),
        np.linspace(-config.max_pitch, config.max_pitch, config.num_pitches),
        config.speed_fractions,
    )
    return np.vstack([fan, np.zeros(3)])


HORIZON = LatticeConfig.horizon  # [s]

_ARRIVAL_MARGIN = 1e-3
"""Fraction of the reach by which a goal must be nearer for the trajectory to stop in it. Observed
goals are clipped to the reach, and rounding must not decide between stopping and flying on."""

BASIS = quintic_basis(WAYPOINT_PERIOD * np.arange(1, NUM_WAYPOINTS + 1), HORIZON)
"""(10, 6), the quintic basis at the waypoints."""


def reference_trajectory(v_B: Any, goal_B: Any, up_B: Any, speed: float, basis: Any = BASIS) -> Any:
    """Computes the obstacle-free reference trajectory: waypoints (..., 10, 3) [m] in B.

    One quintic of the lattice, from the present velocity and the acceleration of level flight, to
    the point that the nominal speed reaches at the horizon, or to rest in the goal. Arrays are
    numpy or torch.

    Args:
        v_B: (..., 3) [m/s], velocity.
        goal_B: (..., 3) [m], the vector to the goal; its length counts up to `HORIZON` x `speed`.
        up_B: (..., 3), the unit vector upwards.
        speed: nominal [m/s].
        basis: `BASIS`, as an array of the same type.
    """
    distance = ((goal_B * goal_B).sum(-1) ** 0.5)[..., None]
    direction = goal_B / distance.clip(min=1e-6)
    slowed = speed * (2.0 * distance / (HORIZON * speed)).clip(MIN_SPEED_FRACTION, 1.0)
    reach = HORIZON * slowed
    arrives = distance <= (1.0 - _ARRIVAL_MARGIN) * reach
    p_end = direction * (distance * arrives + reach * ~arrives)
    v_end = direction * (slowed * ~arrives)
    # The acceleration is `level_acceleration` in the body frame.
    params, upright = QuadrotorParams(), up_B[..., 2:]  # cosine of the tilt
    tilt = -up_B * upright
    tilt[..., 2] += 1.0
    level = v_B - up_B * (v_B * up_B).sum(-1)[..., None]
    a_B = params.gravity * tilt / upright.clip(min=MIN_UPRIGHT) - params.drag * level
    boundary = v_B, a_B, p_end, v_end
    return sum(
        basis[:, column, None] * values[..., None, :] for column, values in enumerate(boundary, 1)
    )
