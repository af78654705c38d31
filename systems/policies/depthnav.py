"""DepthNav: a recurrent depth policy that turns its nose by itself."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.systems.policies.depth_policy_config import DepthPolicyConfig
from splatpilot.systems.policies.depthnav_inference import (
    DEPTHNAV_NETWORK,
    FARTHEST,
    FOV_X,
    IMAGE_SIZE,
    RATE,
    decide,
    heading_yaw,
)
from splatpilot.systems.policies.recurrent_network import load_network
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


@dataclass
class DepthNavConfig(DepthPolicyConfig):
    """The policy's weights, and what it is asked for; its camera's pixels are pooled to 16x12."""

    network = DEPTHNAV_NETWORK
    rate = RATE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=IMAGE_SIZE[0], height=IMAGE_SIZE[1], fov_x=FOV_X, max_depth=FARTHEST
        )
    )


class DepthNav(LeafSystem):
    """Flies to the goal by a 16x12 depth image and what it remembers, and says where to look.

    .. pydrake_system::

        name: DepthNav
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - acceleration
        - heading

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.
    - ``heading`` (1): where body x should point, seen from above [rad] from world x; NaN before.

    Updates at 25 Hz from time 0 by
    :func:`~splatpilot.systems.policies.depthnav_inference.decide`. The discrete state
    holds the acceleration, the heading, the yaw of the start frame (NaN before the first update)
    and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    acceleration_output_port = output_port("acceleration")
    heading_output_port = output_port("heading")

    def __init__(self, config: DepthNavConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DepthNavConfig()
        config.validate()
        self._network = load_network(config.weights, "depthnav", DEPTHNAV_NETWORK)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self.DeclareStateOutputPort("heading", self.DeclareDiscreteState(np.full(1, np.nan)))
        self._start_yaw = self.DeclareDiscreteState(np.full(1, np.nan))
        self._memory = self.DeclareDiscreteState(self._network.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        X_WB = pose_from_state(state)
        start_yaw = float(context.get_discrete_state(int(self._start_yaw)).value()[0])
        if np.isnan(start_yaw):
            start_yaw = heading_yaw(X_WB.rotation().matrix())
        decision = decide(
            self._network,
            np.asarray(image.data)[..., 0],
            X_WB,
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            start_yaw,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, decision.a_WB)
        discrete_state.set_value(1, np.array([decision.heading]))
        discrete_state.set_value(int(self._start_yaw), np.array([start_yaw]))
        discrete_state.set_value(int(self._memory), decision.memory)
