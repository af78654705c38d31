"""The planner that knows the scene: hypotheses from the distance field and the time of arrival."""

import weakref
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem, ValueProducer

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import require_field
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.motion_primitives import level_acceleration
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state


@dataclass
class PrivilegedPlannerConfig:
    """How often and how the planner plans."""

    # [Hz] Plans per second.
    rate: float = 15.0
    # The trajectories and their costs.
    lattice: LatticeConfig = field(default_factory=LatticeConfig)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_field(self, "rate", 0.0 < self.rate <= 1000.0, "in (0, 1000] Hz")
        self.lattice.validate()


def plan(
    time: float,
    state: np.ndarray,
    field: Esdf,
    toa: TimeOfArrival,
    lattice: TrajectoryLattice,
    params: QuadrotorParams | None = None,
    obstacles: Distances | None = None,
) -> Hypotheses:
    """The best K distinct trajectories from a state, cheapest first.

    A pure function of its arguments, for any state: the planner system and whoever labels logged
    states call the same.

    Args:
        time: of the state [s].
        state: (13,) [p_WB, v_WB, q_WB, w_WB_B].
        field: a conservative distance field.
        toa: the time of arrival at the goal, over the same grid.
        lattice: the trajectories to choose from.
        params: the vehicle's; drag and gravity tell its acceleration from its attitude.
        obstacles: what trajectories keep away from, `field` by default; what moves is in it, and
            not in the way to the goal.

    Raises:
        ValueError: if the state is not finite or its quaternion zero.
        InfeasibleFlightError: if no way leads from the free space around p_WB to the goal.
    """
    state = np.asarray(state, dtype=float)
    if state.shape != (13,) or not np.isfinite(state).all():
        raise ValueError(
            f"The state to plan from is {state.tolist()} but must be 13 finite numbers; check the "
            "plant or estimator it comes from."
        )
    X_WB = pose_from_state(state)
    R_WB = X_WB.rotation().matrix()
    p_WB, v_WB, _, _ = QuadrotorState.of(state)
    _check_way_exists(p_WB, field, toa)
    a_WB = level_acceleration(R_WB, v_WB, params or QuadrotorParams())
    positions_W, costs = lattice.best(p_WB, v_WB, a_WB, obstacles or field, toa)
    waypoints_B = (positions_W[:, :NUM_WAYPOINTS] - p_WB) @ R_WB
    return Hypotheses(time, X_WB, waypoints_B, costs)


def _check_way_exists(p_WB: np.ndarray, field: Esdf, toa: TimeOfArrival) -> None:
    # A vehicle that drifts to less than the margin is in a blocked voxel, from which its route is
    # near; what cuts it off is at least its diameter thick. Contact is for others to judge.
    if toa.is_reachable(p_WB, within=VEHICLE_RADIUS):
        return
    clearance = float(field.distance(p_WB)) - VEHICLE_RADIUS
    if clearance > field.voxel_size:
        raise InfeasibleFlightError(
            f"No way leads from p_WB = {np.round(p_WB, 2).tolist()} m, clearance "
            f"{clearance:.2f} m, to the goal p_WG = {np.round(toa.p_WG, 2).tolist()} m: every "
            f"passage is unknown or narrower than the vehicle, {2.0 * VEHICLE_RADIUS:.2f} m, and "
            "its margin; choose start and goal in the same connected free space, or smaller "
            "voxels if a passage is just wide enough."
        )


class PrivilegedPlanner(LeafSystem):
    """Plans K distinct trajectories to the goal through a known distance field.

    .. pydrake_system::

        name: PrivilegedPlanner
        input_ports:
        - state
        - goal
        output_ports:
        - hypotheses

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``hypotheses`` (8 + 31 K): as `Hypotheses.to_vector`, cheapest first, in the body frame B at
      the time of planning; a discrete state, NaN before the first update.

    Updates at ``rate`` (15 Hz) from time 0. Each plan holds the K best distinct ones of a
    lattice of quintic point-mass trajectories, by the cost of `LatticeConfig`. The time of arrival
    is computed once per goal (0.1 s for 400,000 voxels, 1 s for 3 million) and kept in the
    Context's cache. What moves is known ahead: each waypoint keeps clear of where it will be by
    then. The time of arrival knows nothing of it.

    Raises:
        ValueError: from the constructor on a config out of range; from an update if the state is
            not finite.
        InfeasibleFlightError: from an update if the goal is outside the known volume, too close to
            an obstacle or cut off from the vehicle.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    hypotheses_output_port = output_port("hypotheses")

    def __init__(
        self,
        esdf: Esdf,
        config: PrivilegedPlannerConfig | None = None,
        params: QuadrotorParams | None = None,
        moving: MovingSpheres | None = None,
    ) -> None:
        """Constructs the planner.

        Args:
            esdf: the scene; unknown space and all outside its box count as occupied.
            config: see `PrivilegedPlannerConfig`.
            params: the vehicle's, see `plan`.
            moving: what moves in the scene.
        """
        super().__init__()
        self._config = config or PrivilegedPlannerConfig()
        self._config.validate()
        self._params = params or QuadrotorParams()
        self._params.validate()
        self._field = esdf if esdf.occupied_outside else esdf.conservative()
        self._moving = moving
        self._lattice = TrajectoryLattice(self._config.lattice)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        plans = self.DeclareDiscreteState(no_plan(self._config.lattice.num_hypotheses))
        self.DeclareStateOutputPort("hypotheses", plans)
        # The march belongs to the start of a simulation, not to its first instant.
        self.DeclareInitializationPublishEvent(self._march)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / self._config.rate, 0.0, self._update)
        # Drake would never free a system that its own cache entry refers to, nor one that keeps the
        # entry itself: hence a weak reference, and the index.
        planner = weakref.proxy(self)
        self._time_of_arrival = self.DeclareCacheEntry(
            "time of arrival",
            ValueProducer(
                Value[object],  # pyright: ignore[reportArgumentType]
                lambda context, value: planner._calc_time_of_arrival(context, value),
            ),
            {self._goal_port.ticket()},
        ).cache_index()

    def _calc_time_of_arrival(self, context, value) -> None:
        p_WG = np.asarray(self._goal_port.Eval(context))
        last = value.get_value()
        # A goal port reports a change at every step if its source is not a constant; only a
        # change of the goal itself is worth the march.
        if not isinstance(last, TimeOfArrival) or not np.array_equal(last.p_WG, p_WG):
            value.set_value(time_of_arrival(self._field, p_WG, self._config.lattice.margin))

    def _march(self, context: Context) -> None:
        self.get_cache_entry(self._time_of_arrival).Eval(context)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time, obstacles = context.get_time(), None
        if self._moving is not None:
            obstacles = self._moving.along(self._field, time + self._lattice.sample_times)
        hypotheses = plan(
            time,
            np.asarray(self._state_port.Eval(context)),
            self._field,
            cast(TimeOfArrival, self.get_cache_entry(self._time_of_arrival).Eval(context)),
            self._lattice,
            self._params,
            obstacles,
        )
        discrete_state.set_value(hypotheses.to_vector())
