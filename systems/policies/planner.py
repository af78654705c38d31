"""PrivilegedPlanner: plans in the known distance field, by a lattice and the time of arrival."""

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, DiscreteValues, ValueProducer

from splatpilot.systems.collision.distance_field import Distances
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.drake import optional_input, weak_callback
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import Config, bounded, require, require_type
from splatpilot.systems.policies.base import Policy
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice, level_acceleration
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state


@dataclass
class PrivilegedPlannerConfig(Config):
    """Rate and lattice of the planner."""

    # [Hz] Plans per second.
    rate: float = bounded(15.0, "(0, 1000] Hz")
    # The trajectories and their costs.
    lattice: LatticeConfig = field(default_factory=LatticeConfig)


def plan(
    time: float,
    state: np.ndarray,
    field: Esdf,
    toa: TimeOfArrival,
    lattice: TrajectoryLattice,
    params: QuadrotorParams | None = None,
    obstacles: Distances | None = None,
) -> Hypotheses:
    """Plans the K best distinct trajectories of a lattice from a state (13,), cheapest first.

    `field` is conservative, and `toa` over the same grid. `obstacles` are the distances for the
    costs, those of `field` by default; they may include moving obstacles.
    """
    valid = np.shape(state) == (13,) and bool(np.isfinite(state).all())
    remedy = "check the plant or estimator it comes from"
    require(valid, "the state", "13 finite numbers", np.asarray(state).tolist(), remedy)
    X_WB = pose_from_state(state)
    R_WB = X_WB.rotation().matrix()
    p_WB, v_WB, _, _ = QuadrotorState.of(state)
    clearance = float(field.distance(p_WB)) - VEHICLE_RADIUS
    # A vehicle that drifts into the margin is in a blocked voxel near free ones; walls are at least
    # as thick as the vehicle. Contact is detected elsewhere.
    if clearance > field.voxel_size and not toa.is_reachable(p_WB, within=VEHICLE_RADIUS):
        raise InfeasibleFlightError(
            f"no path leads from p_WB = {np.round(p_WB, 2).tolist()} m, clearance "
            f"{clearance:.2f} m, to the goal p_WG = {np.round(toa.p_WG, 2).tolist()} m: every "
            f"passage is unknown or narrower than the vehicle, {2.0 * VEHICLE_RADIUS:.2f} m, and "
            "its margin; choose start and goal in the same free space, or smaller voxels"
        )
    a_WB = level_acceleration(R_WB, v_WB, params or QuadrotorParams())
    positions_W, costs = lattice.best(p_WB, v_WB, a_WB, obstacles or field, toa)
    waypoints_B = (positions_W[:, :NUM_WAYPOINTS] - p_WB) @ R_WB
    return Hypotheses(time, X_WB, waypoints_B, costs)


class PrivilegedPlanner(Policy):
    """Plans K distinct trajectories to the goal through a known distance field.

    .. pydrake_system::

        name: PrivilegedPlanner
        input_ports: [state, goal, moving (optional)]
        output_ports: [hypotheses]

    - ``hypotheses`` (8 + 31 K): as `Hypotheses.to_vector`, cheapest first, in the body frame B at
      the time of planning; NaN before the first update.

    Unknown space and all outside the box of `esdf` count as occupied. The time of arrival is
    computed once per goal and cached in the Context. It ignores the bodies of `moving`; the costs
    of trajectories know their future positions, see `MovingBodies`. Updates raise
    InfeasibleFlightError if the goal is outside the known volume, too close to an obstacle or cut
    off from the vehicle.

    Supports the scalars float and AutoDiffXd; its hypotheses have zero derivatives.
    """

    def __init__(
        self,
        esdf: Esdf,
        config: PrivilegedPlannerConfig | None = None,
        params: QuadrotorParams | None = None,
    ) -> None:
        config = PrivilegedPlannerConfig() if config is None else config
        require_type(esdf, Esdf, "esdf", "pass the `esdf` of a world")
        require_type(config, PrivilegedPlannerConfig, "config")
        super().__init__(config)
        lattice = self.config.lattice
        self._params = params or QuadrotorParams()
        self._params.validate()
        self._field = esdf if esdf.occupied_outside else esdf.conservative()
        self._lattice = TrajectoryLattice(lattice)
        self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
        self.declare_state(no_plan(lattice.num_hypotheses), "hypotheses")
        # The march belongs to the start of a simulation, not to its first instant.
        self.DeclareInitializationPublishEvent(self._prepare)
        self._arrival = self.DeclareCacheEntry(
            "time of arrival",
            ValueProducer(cast(Any, Value[object]), weak_callback(self._march)),
            {self._goal_port.ticket()},
        ).cache_index()

    def _march(self, context: Context, value: Any) -> None:
        p_WG = np.asarray(self._goal_port.Eval(context))
        last = value.get_value()
        # A goal port whose source is not constant reports a change at every step.
        if not isinstance(last, TimeOfArrival) or not np.array_equal(last.p_WG, p_WG):
            value.set_value(time_of_arrival(self._field, p_WG, self.config.lattice.margin))

    def _prepare(self, context: Context) -> None:
        self._time_of_arrival(context)

    def _time_of_arrival(self, context: Context) -> TimeOfArrival:
        return cast(TimeOfArrival, self.get_cache_entry(self._arrival).Eval(context))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time, obstacles = context.get_time(), None
        if bodies := optional_input(self, "moving", context):
            obstacles = bodies.along(self._field, bodies.time + self._lattice.sample_times)
        state, arrival = np.asarray(self._state_port.Eval(context)), self._time_of_arrival(context)
        hypotheses = plan(time, state, self._field, arrival, self._lattice, self._params, obstacles)
        discrete_state.set_value(hypotheses.to_vector())
