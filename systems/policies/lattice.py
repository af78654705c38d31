"""A lattice of quintic point-mass trajectories, their costs and the K best distinct ones.

From the present position, velocity and acceleration, quintic polynomials (the minimum-jerk curves
between boundary states) lead to a fan of final velocities and to points of the way to the goal. All
are evaluated at once: positions and jerks are linear in the boundary states, so they are one matrix
product, and their clearances one batched look-up in the distance field.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.common.validation import require, require_field
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.systems.policies.motion_primitives import (
    STEEPEST,
    lengths,
    quintic_basis,
    rotation_to,
    select_distinct,
    velocity_fan,
)
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, slowness
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams

LEAST_SPEED_FRACTION = 0.25  # of the nominal speed, near a goal that is not in direct reach

_PACES = 1.0, 0.5, 0.25
"""Fractions of the nominal speed, tried in turn while nothing beats waiting: in a narrow bend the
quintics of a fast lattice cut the corner, and those of a slow one follow the route."""


@dataclass
class LatticeConfig:
    """The lattice, the weights of its cost and how many trajectories are kept.

    The cost of a trajectory with samples p_i, in seconds of way at 1 m/s, is::

        T(p_N) + sum (S(d_i) - 1) |p_i - p_(i-1)|           time of arrival and what nearness adds
        + penetration_weight sum max(0, r + margin - d_i)   contact
        + speed_weight mean max(0, |v_i| - speed)² + jerk_weight mean |j_i|²

    with the time of arrival T, the slowness S, the distances d_i and the radius r. T and S belong
    together: along the way to the goal a trajectory costs T at its start less its own length, at
    any speed, so that going on always beats waiting. A barrier that T does not know of would hold
    the vehicle before narrow places.
    """

    # [m/s] Nominal speed.
    speed: float = 2.0
    # [s] Duration of the trajectories, a multiple of 0.1 s, the time between samples.
    horizon: float = 2.0
    # [-] Number of directions to the sides.
    num_yaws: int = 25
    # [rad] Largest angle to the sides.
    max_yaw: float = 1.745
    # [-] Number of directions up and down.
    num_pitches: int = 7
    # [rad] Largest angle up and down.
    max_pitch: float = 0.5
    # [-] Final speeds as fractions of the nominal speed.
    speed_fractions: list[float] = field(default_factory=lambda: [0.33, 0.67, 1.0])
    # [-] How many trajectories are kept.
    num_hypotheses: int = 3
    # [m] Mean distance between two of them, for them to count as distinct.
    separation: float = 0.35
    # [m] Clearance kept for errors of tracking and of the field's grid.
    margin: float = 0.05
    # [s/m] Weight of coming closer to obstacles than radius and margin.
    penetration_weight: float = 200.0
    # [s^3/m^2] Weight of flying faster than the nominal speed.
    speed_weight: float = 10.0
    # [s^7/m^2] Weight of the jerk.
    jerk_weight: float = 0.003

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("num_yaws", "num_pitches", "num_hypotheses"):
            require_field(self, name, getattr(self, name) >= 1, "at least 1")
        for name, most, unit in (("speed", 20.0, "m/s"), ("horizon", 30.0, "s")):
            valid = 0.0 < getattr(self, name) <= most
            require_field(self, name, valid, f"in (0, {most:g}] {unit}")
        samples = self.horizon / WAYPOINT_PERIOD
        whole = samples > NUM_WAYPOINTS - 0.5 and abs(samples - round(samples)) < 1e-6
        least = NUM_WAYPOINTS * WAYPOINT_PERIOD
        require_field(self, "horizon", whole, f"a multiple of 0.1 s and at least {least} s")
        weights = "penetration_weight", "speed_weight", "jerk_weight"
        for name in (*weights, "separation", "margin", "max_yaw", "max_pitch"):
            require_field(self, name, 0.0 <= getattr(self, name) <= 1e6, "0 to 1e6")
        require_field(self, "max_yaw", self.max_yaw <= math.pi, "at most pi")
        require_field(self, "max_pitch", self.max_pitch < math.pi / 2, "less than pi/2")
        in_range = bool(self.speed_fractions) and all(0.0 < f <= 1.0 for f in self.speed_fractions)
        require_field(self, "speed_fractions", in_range, "one or more values in (0, 1]")
        trajectories = self.num_yaws * self.num_pitches * len(self.speed_fractions)
        what = "LatticeConfig.num_yaws and num_pitches"
        require(trajectories <= 10**5, what, "at most 1e5 in all", trajectories)
        few = self.num_hypotheses <= trajectories
        require_field(
            self,
            "num_hypotheses",
            few,
            f"at most {trajectories}, the size of the lattice",
        )


class Trajectories(NamedTuple):
    """Trajectories as samples every 0.1 s, from 0.1 s after now to the horizon, in the world."""

    positions: np.ndarray  # (N, S, 3) [m]
    jerks: np.ndarray  # (N, S, 3) [m/s^3]


class TrajectoryLattice:
    """The quintics from a state to a fan of final velocities, their costs, and the best of them."""

    def __init__(self, config: LatticeConfig | None = None) -> None:
        """Prepares what does not depend on the state.

        Raises:
            ValueError: on a config out of range.
        """
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
        """The N trajectories from a position, velocity and acceleration, (3,) each.

        After the horizon H they end without acceleration: those of the lattice, which points down
        the gradient of T, with its velocities v_1 at p_WB + H v_1; one more for each speed on the
        way to the goal, after that length and along it, or at rest in the goal. The speed falls in
        proportion to the time of arrival where the nominal one would take less than half the
        horizon. `pace` multiplies every speed.
        """
        config = self.config
        slowing = float(toa.value(p_WB)) / self._stopping_distance
        speed = pace * config.speed * min(max(slowing, LEAST_SPEED_FRACTION), 1.0)
        v_L = speed * self._final_velocities_L @ rotation_to(-toa.gradient(p_WB)).T
        speeds = speed * np.array(config.speed_fractions)
        p_way, directions = toa.way(p_WB, config.horizon * speeds)
        count = len(v_L) + len(speeds)
        boundary = np.zeros((6, count, 3))
        boundary[0], boundary[1], boundary[2] = p_WB, v_WB, a_WB
        boundary[3] = np.concatenate([p_WB + config.horizon * v_L, p_way])
        boundary[4] = np.concatenate([v_L, speeds[:, None] * directions])
        samples = self._basis @ boundary.reshape(6, -1)  # (2 S, 3 N)
        samples = samples.reshape(2, -1, count, 3).swapaxes(1, 2)
        return Trajectories(positions=samples[0], jerks=samples[1])

    def costs(
        self, trajectories: Trajectories, p_WB: np.ndarray, field: Distances, toa: TimeOfArrival
    ) -> np.ndarray:
        """The costs (N,) of trajectories that start at p_WB (3,) [m], see `LatticeConfig`.

        Args:
            trajectories: N of them.
            p_WB: where they start [m].
            field: distances that are known everywhere, as those of `Esdf.conservative()` are.
            toa: the time of arrival at the goal.
        """
        config = self.config
        positions, jerks = trajectories
        distances = field.distance(positions)  # (N, S)
        starts = np.broadcast_to(p_WB, (len(positions), 1, 3))
        steps = lengths(np.diff(positions, axis=1, prepend=starts))  # (N, S) [m]
        nearness = ((slowness(distances) - 1.0) * steps).sum(axis=1)
        too_close = np.maximum(VEHICLE_RADIUS + config.margin - distances, 0.0)
        too_fast = np.maximum(steps / WAYPOINT_PERIOD - config.speed, 0.0)
        return (
            toa.value(positions[:, -1])
            + nearness
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
        """The positions (K, S, 3) [m] and costs (K,) of the K best distinct trajectories.

        The first is the cheapest of all; see `trajectories`, `costs` and `select_distinct`. While
        the cheapest leads no nearer to a goal out of reach, slower ones are tried, and taken if
        cheaper.
        """
        config = self.config
        arrival = float(toa.value(p_WB))
        positions, costs = np.empty(0), np.array([np.inf])
        for pace in _PACES:
            trajectories = self.trajectories(p_WB, v_WB, a_WB, toa, pace)
            found = self.costs(trajectories, p_WB, field, toa)
            if found.min() < costs.min():
                positions, costs = trajectories.positions, found
            nearer = toa.value(positions[np.argmin(costs), -1]) < arrival
            if nearer or arrival < self._stopping_distance:
                break
        chosen = select_distinct(positions, costs, config.num_hypotheses, config.separation)
        return positions[chosen], costs[chosen]


def final_velocities(config: LatticeConfig) -> np.ndarray:
    """The final velocities (N, 3) in units of the speed, lattice frame L; the last is rest."""
    fan = velocity_fan(
        np.linspace(-config.max_yaw, config.max_yaw, config.num_yaws),
        np.linspace(-config.max_pitch, config.max_pitch, config.num_pitches),
        config.speed_fractions,
    )
    return np.vstack([fan, np.zeros(3)])


# The way to a goal where nothing stands in it, in closed form.
#
# What the planner's lattice flies there: one quintic to where the nominal speed leads in its
# horizon, or to rest in the goal, from the present velocity and the acceleration of level flight.


HORIZON = LatticeConfig.horizon  # [s]

MARGIN = 1e-3
"""[-] Part of the reach by which a goal is nearer that is arrived at. Goals beyond are told as
exactly there: rounding must not decide between stopping and flying on."""

BASIS = quintic_basis(WAYPOINT_PERIOD * np.arange(1, NUM_WAYPOINTS + 1), HORIZON)
"""(10, 6), see `quintic_basis`; of the waypoints."""


def unobstructed_way(
    v_B: Any, goal_B: Any, up_B: Any, speed: float, basis: Any = BASIS, margin: float = MARGIN
) -> Any:
    """Waypoints (..., 10, 3) [m] in the body frame B, by arithmetic that arrays of numpy and
    tensors of torch have in common.

    Args:
        v_B: (..., 3) [m/s], velocity.
        goal_B: (..., 3) [m], the vector to the goal; all are alike from `HORIZON` x `speed` on.
        up_B: (..., 3), the unit vector upwards.
        speed: [m/s], nominal.
        basis: `BASIS`, as an array of the same kind.
        margin: see `MARGIN`.
    """
    distance = ((goal_B * goal_B).sum(-1) ** 0.5)[..., None]
    direction = goal_B / distance.clip(min=1e-6)
    slowed = speed * (2.0 * distance / (HORIZON * speed)).clip(LEAST_SPEED_FRACTION, 1.0)
    reach = HORIZON * slowed
    arrives = distance <= (1.0 - margin) * reach
    p_end = direction * (distance * arrives + reach * ~arrives)
    v_end = direction * (slowed * ~arrives)
    boundary = v_B, _level_acceleration(v_B, up_B), p_end, v_end
    return sum(
        basis[:, column, None] * values[..., None, :] for column, values in enumerate(boundary, 1)
    )


def _level_acceleration(v_B: Any, up_B: Any) -> Any:
    """See `motion_primitives.level_acceleration`; in the body frame."""
    upright = up_B[..., 2:]  # the cosine of the tilt
    tilt = -up_B * upright
    tilt[..., 2] += 1.0
    level = v_B - up_B * (v_B * up_B).sum(-1)[..., None]
    params = QuadrotorParams()
    return params.gravity * tilt / upright.clip(min=STEEPEST) - params.drag * level
