"""Reactive: a classical policy that sees depth and has learned nothing."""

from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.policies.reactive_planner import (
    ReactiveConfig,
    candidate_costs,
    candidate_velocities,
    is_seen,
    nearest_points,
    responses,
)
from splatpilot.systems.policies.velocity_tracking import approach_velocity, tracking_acceleration
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


class Reactive(LeafSystem):
    """Turns away from what its depth camera has seen in the last second.

    .. pydrake_system::

        name: Reactive
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.

    Updates at ``rate`` (15 Hz) from time 0: of a fan of velocities the cheapest by
    `candidate_costs`, and the acceleration that leads to it. The discrete state holds the
    acceleration and, in a ring, the points of the last ``memory`` images in the world frame, NaN
    where there are none.

    Raises:
        ValueError: from the constructor on a config out of range.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: ReactiveConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or ReactiveConfig()
        config.validate()
        camera = config.camera
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(camera.width, camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self._points = self.DeclareDiscreteState(
            np.full(config.memory * config.rows * config.columns * 3, np.nan)
        )
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        config = self._config
        state = np.asarray(self._state_port.Eval(context))
        p_WG = np.asarray(self._goal_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        depth = np.asarray(image.data)[..., 0].astype(float)
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WC = pose_from_state(state) @ config.camera.X_BC()
        R_WC, p_WC = X_WC.rotation().matrix(), X_WC.translation()

        points = nearest_points(depth, config) @ R_WC.T + p_WC
        old = np.array(context.get_discrete_state(int(self._points)).value()).reshape(-1, 3)
        remembered = np.concatenate([points, old[: -len(points)]])

        v_fan = candidate_velocities(p_WG - p_WB, config)
        v_fan = np.vstack([v_fan, approach_velocity(p_WB, p_WG, config.speed)])
        positions = responses(p_WB, v_WB, v_fan, config.horizon)
        seen = is_seen((positions - p_WC) @ R_WC, depth, config.camera)
        known = remembered[np.isfinite(remembered[:, 0])]
        costs = candidate_costs(positions, v_fan, p_WB, v_WB, p_WG, known, seen, config)
        v_wanted = v_fan[np.argmin(costs)]

        discrete_state.set_value(0, tracking_acceleration(v_WB, v_wanted))
        discrete_state.set_value(int(self._points), remembered.ravel())
